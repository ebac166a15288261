from typing import Any

import numpy as np
import pytest
import torch
from conftest import SharedEnv
from metered_task import Metered

import lyceum_warp as lw


@pytest.fixture
def env(shared_env: SharedEnv) -> lw.Env:
    return shared_env(Metered, nworld=3, horizon=10, far=0.3)


def filled(env: lw.Env, steps: int, *, capacity: int = 45, bad: int = -1) -> tuple[lw.Replay, list[dict[str, Any]]]:
    """Take random steps, and store them in a buffer and in a plain list.

    World 1 gets a non-finite action in step ``bad``.
    """
    replay, plain = lw.Replay(env, capacity), []
    random = torch.Generator().manual_seed(0)
    for t in range(steps):
        action = torch.empty_like(env.action).uniform_(-1.0, 1.0, generator=random)
        if t == bad:
            action[1] = torch.nan
        before = {group: obs.clone() for group, obs in env.obs_groups.items()}
        replay.step(action)
        plain.append({
            "obs": before, "action": action.nan_to_num(0.0), "reward": env.reward.clone(),
            "terminated": env.terminated.clone(), "truncated": env.truncated.clone(),
            "next_obs": {group: obs.clone() for group, obs in env.final_obs_groups.items()},
        })  # fmt: skip
    return replay, plain


@pytest.mark.parametrize("n_step", [1, 3, 20])
@pytest.mark.parametrize("steps", [7, 40])
def test_n_step_returns_across_episode_ends_equal_a_plain_sum(steps: int, n_step: int, env: lw.Env) -> None:
    replay, plain = filled(env, steps, bad=5)
    kept, gamma, ends = plain[-15:], 0.9, set()
    assert len(replay) == 3 * len(kept)
    batch = replay.at(torch.arange(len(replay)), n_step=n_step, gamma=gamma)
    for i in range(len(replay)):
        first, world = divmod(i, 3)
        total, discount = 0.0, 1.0
        for sample in kept[first : first + n_step]:
            total += discount * sample["reward"][world].item()
            discount *= gamma
            ends.add((bool(sample["terminated"][world]), bool(sample["truncated"][world])))
            if sample["terminated"][world]:
                discount = 0.0
            if sample["terminated"][world] or sample["truncated"][world]:
                break
        np.testing.assert_allclose(batch.reward[i].item(), total, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(batch.discount[i].item(), discount, rtol=1e-5)
        assert torch.equal(batch.action[i], kept[first]["action"][world])
        for group in ("policy", "critic"):
            assert torch.equal(batch.obs[group][i], kept[first]["obs"][group][world])
            assert torch.equal(batch.next_obs[group][i], sample["next_obs"][group][world])
    assert (False, True) in ends and (steps == 7 or (True, False) in ends)


def test_replay_samples_are_uniform_and_reproducible(env: lw.Env) -> None:
    replay, _ = filled(env, 20)
    draws = [replay.sample(20_000, generator=torch.Generator().manual_seed(3)) for _ in range(2)]
    assert torch.equal(draws[0].reward, draws[1].reward)
    _, counts = draws[0].obs["critic"].unique(dim=0, return_counts=True)
    assert len(counts) == 45 and counts.min() > 300 and counts.max() < 600  # 444 each


def test_restored_replay_buffer_continues_identically(env: lw.Env) -> None:
    replay, _ = filled(env, 20)
    other = lw.Replay(env, 45)
    other.load_state_dict(replay.state_dict())
    index = torch.arange(45)
    for _ in range(2):
        one, same = (buffer.at(index, n_step=3, gamma=0.9) for buffer in (replay, other))
        assert torch.equal(one.reward, same.reward) and torch.equal(one.next_obs["critic"], same.next_obs["critic"])
        state = env.get_state()
        for buffer in (replay, other):
            env.set_state(state)
            buffer.step(torch.zeros(3, 1))
    with pytest.raises(ValueError, match=r"\(15, 3\).* needs .*\(22, 3\)"):
        lw.Replay(env, 90).load_state_dict(replay.state_dict())


def test_the_default_capacity_depends_on_worlds_and_memory(env: lw.Env, monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(lw.Replay(env).reward) == 333_334
    each = 4 * (2 * 3 + 1 + 1) + 2
    monkeypatch.setattr("lyceum_warp.algos.common.replay.free_memory", lambda device: 1000 * each)
    assert lw.Replay(env).steps == 100 and lw.Replay(env).nbytes == 100 * 3 * each
    with pytest.raises(ValueError, match="capacity must be a whole number from 1 "):
        lw.Replay(env, 0)
    with pytest.raises(ValueError, match="steps in a replay buffer need about"):
        lw.Replay(env, 10**13)
    with pytest.raises(ValueError, match=r"the replay buffer is empty: call step\(\) before sample\(\)"):
        lw.Replay(env, 45).sample(8)
