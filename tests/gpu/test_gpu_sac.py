from typing import Any

import pytest
import torch
from metered_task import Metered
from test_gpu import CUDA, nothing_waits

import lyceum_warp as lw

pytestmark = pytest.mark.gpu


def made(**changes: Any) -> lw.SAC:
    config: dict[str, Any] = {
        "hidden": (16, 8), "value_hidden": (8, 8), "num_steps": 12, "warmup": 128, "updates": 4, "batch": 64,
        "mean_every": 0, "tf32": False,
    }  # fmt: skip
    env = lw.make(Metered, nworld=64, horizon=10, far=0.3, device=CUDA)
    return lw.SAC(env, config=lw.SACConfig(**config | changes))


@pytest.mark.parametrize("changes", [{}, {"n_step": 3, "actor_every": 2, "critic_bound": "mean", "replay": 640}])
def test_captured_updates_equal_updates_without_graphs(changes: dict[str, Any]) -> None:
    captured, direct = made(**changes), made(**changes)
    direct._learn.enabled = False
    for _ in range(3):
        one, other = next(captured), next(direct)
        for name in ("critic_loss", "q_mean", "actor_loss", "entropy", "temperature"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=2e-2, abs=2e-3), name
        for module, same in ((captured.policy, direct.policy), (captured.value, direct.value)):
            for name, part in module.state_dict().items():
                torch.testing.assert_close(part, same.state_dict()[name], rtol=2e-2, atol=2e-3, msg=name)
    assert captured._learn.graph is not None and direct._learn.graph is None


@pytest.mark.parametrize("changes", [{"bf16": True}, {"compiled": True}, {"compiled": True, "bf16": True}])
def test_faster_arithmetic_gives_nearly_equal_losses(changes: dict[str, Any]) -> None:
    fast, plain = made(**changes), made()
    for _ in range(3):
        one, other = next(fast), next(plain)
    for name in ("critic_loss", "q_mean", "entropy"):
        assert getattr(one, name) == pytest.approx(getattr(other, name), rel=0.1, abs=0.05), name


def test_an_iteration_waits_for_the_device_only_at_its_end() -> None:
    sac = made()
    for _ in range(2):  # the first call loads kernels, and the second call captures graphs
        next(sac)
    sac.rollout.begin()
    with nothing_waits():
        for _ in range(3):
            sac.sample()
            sac.draw()
            sac._learn()


def test_learner_captures_new_graphs_after_loading_a_state() -> None:
    one = made()
    for _ in range(2):
        next(one)
    other = made()
    next(other)
    next(other)  # the old graph contains addresses of the optimizer's old moments
    other.load_state_dict(one.state_dict())
    other.replay.load_state_dict(one.replay.state_dict())
    for _ in range(2):
        first, second = next(one), next(other)
        assert second.critic_loss == pytest.approx(first.critic_loss, rel=2e-2, abs=1e-3)
        assert second.temperature == pytest.approx(first.temperature, rel=1e-3)


def test_sac_learns_on_a_gpu() -> None:
    config = lw.SACConfig(hidden=(64, 64), value_hidden=(64, 64), mean_every=20, batch=1024, warmup=5000)
    sac = lw.SAC(lw.make("inverted_pendulum", nworld=64, device=CUDA), config=config)
    rows = [next(sac) for _ in range(20)]
    assert rows[-1].mean_return is not None and rows[-1].mean_return > 200.0 > 20.0 > rows[0].return_mean
