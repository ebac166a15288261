from typing import Any

import pytest
import torch
from metered_task import Metered
from test_gpu import CUDA, nothing_waits

import lyceum_warp as lw

pytestmark = pytest.mark.gpu


def made(**changes: Any) -> lw.PPO:
    config: dict[str, Any] = {"hidden": (16, 8), "value_hidden": (8,), "num_steps": 12, "mean_every": 0, "tf32": False}
    env = lw.make(Metered, nworld=64, horizon=10, device=CUDA)
    return lw.PPO(env, config=lw.PPOConfig(**config | changes))


@pytest.mark.parametrize("changes", [
    {}, {"std_type": "log", "whiten_minibatches": True, "minibatches": 5, "clip_value_loss": False},
    {"recurrent": 6}, {"recurrent": 6, "value_group": "policy", "whiten_minibatches": True, "minibatches": 5},
])  # fmt: skip
def test_captured_epochs_equal_epochs_without_graphs(changes: dict[str, Any]) -> None:
    changes = {"schedule": "fixed", "final_entropy_coef": 0.1, "entropy_decay": (1, 4)} | changes
    captured, direct = made(**changes), made(**changes)
    direct.minibatches.epoch.enabled = False
    for _ in range(5):
        one, other = next(captured), next(direct)
        for name in ("kl", "std_mean", "surrogate_loss", "entropy", "value_loss"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=2e-2, abs=2e-3), name
        for module, same in ((captured.policy, direct.policy), (captured.value, direct.value)):
            for name, part in module.state_dict().items():
                torch.testing.assert_close(part, same.state_dict()[name], rtol=2e-2, atol=2e-3, msg=name)
    assert captured.minibatches.epoch.graph is not None and direct.minibatches.epoch.graph is None


def test_learning_rate_adapts_within_a_graph() -> None:
    for wanted, rate in ((1e-9, 1e-5), (1e6, 1e-2)):
        ppo = made(desired_kl=wanted)
        assert [next(ppo).learning_rate for _ in range(3)] == pytest.approx([rate] * 3)


@pytest.mark.parametrize("changes", [{}, {"recurrent": 6, "value_group": "policy"}])
def test_an_iteration_waits_for_the_device_only_at_its_end(changes: dict[str, Any]) -> None:
    ppo = made(**changes)
    for _ in range(2):  # the first call loads kernels, and the second call captures graphs
        next(ppo)
    with nothing_waits():
        ppo.sample()
        samples = ppo.evaluated_samples()
        ppo.update(samples)
        ppo.divergence()


def test_learner_captures_new_graphs_after_loading_a_state() -> None:
    one = made()
    for _ in range(3):
        next(one)
    other = made(learning_rate=2e-3)
    next(other)
    next(other)  # the old graph contains addresses of the optimizer's old moments
    other.load_state_dict(one.state_dict())
    for _ in range(3):
        first, second = next(one), next(other)
        assert second.learning_rate == pytest.approx(first.learning_rate)
        assert second.value_loss == pytest.approx(first.value_loss, rel=2e-2, abs=1e-3)


def test_ppo_learns_on_a_gpu() -> None:
    config = lw.PPOConfig(hidden=(32, 32), value_hidden=(32, 32), mean_every=60)
    ppo = lw.PPO(lw.make("point_mass", nworld=64, device=CUDA), config=config)
    rows = [next(ppo) for _ in range(60)]
    assert rows[-1].mean_return is not None and rows[-1].mean_return > 150.0
