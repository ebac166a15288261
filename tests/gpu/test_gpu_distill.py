from typing import Any

import pytest
import torch
from metered_task import Metered
from test_gpu import CUDA, nothing_waits

import lyceum_warp as lw

pytestmark = pytest.mark.gpu


def made(**changes: Any) -> lw.Distill:
    config: dict[str, Any] = {"hidden": (16, 8), "num_steps": 12, "gradient_length": 4, "mean_every": 0, "tf32": False}
    torch.manual_seed(0)
    env, teacher = lw.make(Metered, nworld=64, horizon=10, device=CUDA), lw.GaussianPolicy(2, 1, (4,), recurrent=3)
    return lw.Distill(env, config=lw.DistillConfig(**config, teacher_group="critic", **changes), teacher=teacher)


@pytest.mark.parametrize("changes", [{}, {"recurrent": 6}])
def test_captured_epochs_equal_epochs_without_graphs(changes: dict[str, Any]) -> None:
    captured, direct = made(**changes), made(**changes)
    direct._epoch.enabled = False
    for _ in range(4):
        one, other = next(captured), next(direct)
        assert one.loss == pytest.approx(other.loss, rel=1e-2, abs=1e-5)
        for name, part in captured.policy.state_dict().items():
            torch.testing.assert_close(part, direct.policy.state_dict()[name], rtol=2e-2, atol=2e-3, msg=name)
    assert captured._epoch.graph is not None and direct._epoch.graph is None


def test_an_iteration_waits_for_the_device_only_at_its_end() -> None:
    learner = made(recurrent=6)
    for _ in range(2):
        next(learner)
    with nothing_waits():
        learner.sample()
        learner.update()


def test_demonstrations_are_recalled_on_a_gpu() -> None:
    env = lw.make("point_mass", nworld=64, device=CUDA)
    episode = lw.Trajectory.__new__(lw.Trajectory)
    for name, size in (("obs", (31, 6)), ("actions", (30, 2))):
        object.__setattr__(episode, name, torch.randn(size))
    learner = lw.Distill(env, config=lw.DistillConfig(hidden=(8,), mean_every=0), teacher=lw.Demonstrations([episode]))
    assert [next(learner).iteration for _ in range(3)] == [1, 2, 3]
