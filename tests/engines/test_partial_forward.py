"""A forward pass of restarting worlds alone gives the same numbers as a forward pass of all worlds."""

import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.engines.warp.warp_engine import WarpEngine


def test_partial_passes_give_the_same_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """In groups of one world or all together, a run is the same to the bit."""
    runs = []
    for partial in (True, False):
        monkeypatch.setattr(WarpEngine, "partial_refresh", partial)
        env = lw.make("humanoid", engine="warp", nworld=3, horizon=5, seed=1)
        state = env.get_state()
        state[1, env.state_space.parts["step"]] = 3
        env.set_state(state)
        run = []
        for _ in range(8):
            env.step(torch.full_like(env.action, 0.3))
            run.append((env.done.clone(), env.obs.clone(), env.get_state()))
        runs.append(run)
    assert sum(int(done.sum()) for done, *_ in runs[0]) >= 4
    for one, other in zip(*runs, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("partial", [True, False])
def test_an_overflow_in_the_first_state_of_an_episode_is_reported(
    partial: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first step reports it; here a world starts in more contacts than have room."""
    monkeypatch.setattr(WarpEngine, "partial_refresh", partial)
    spec = lw.gymnasium_model("humanoid.xml").spec()
    spec.body("torso").pos[2] = 0.1
    env = lw.make("humanoid", engine="warp", nworld=2, model=spec, nconmax=1, njmax=128, reset_noise_scale=0.0,
                  autoreset=False)  # fmt: skip
    env.reset(torch.tensor([True, False]))
    assert not env.done.any()
    env.step()
    assert env.done_reason[0] & int(lw.Done.CONTACT_OVERFLOW)
