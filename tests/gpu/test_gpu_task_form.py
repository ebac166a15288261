import pytest
import torch
from full_task import Full
from test_gpu import nothing_waits

import lyceum_warp as lw
from lyceum_warp.testing import check_task

pytestmark = pytest.mark.gpu


def test_task_with_every_feature_passes_check_task_on_a_gpu() -> None:
    check_task(Full, device="cuda", steps=50)


def test_worlds_on_a_gpu_equal_worlds_of_the_c_engine() -> None:
    gpu, cpu = (lw.make(Full, nworld=200, device=device, seed=3) for device in ("cuda", "cpu"))
    generator = torch.Generator().manual_seed(0)
    for _ in range(50):
        action = 2 * torch.rand(cpu.action.shape, generator=generator) - 1
        gpu.step(action.cuda())
        cpu.step(action)
        for name in gpu.obs_groups:
            # in float32, a contact may begin in a different substep in a few worlds
            error = (gpu.obs_groups[name].cpu() - cpu.obs_groups[name]).abs().amax(dim=1)
            assert error.median() < 1e-5
            assert (error < 1e-2).float().mean() > 0.9
        gpu.set_state(cpu.get_state().to(gpu.get_state()))
    assert not any(gpu.fault_counts.values())


@pytest.mark.parametrize("task", [Full, "go1_velocity"], ids=["full", "go1_velocity"])
def test_step_with_every_feature_does_not_wait_for_the_device(task: type[lw.Task] | str) -> None:
    env = lw.make(task, nworld=64, device="cuda")
    for _ in range(5):
        env.step()
    with nothing_waits():
        for _ in range(10):
            env.step()
