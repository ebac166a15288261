import numpy as np
import pytest
import torch
from full_task import Full
from test_gpu import CUDA, nothing_waits

from lyceum_warp.gym import GymnasiumVectorEnv

pytestmark = pytest.mark.gpu
N = 64


@pytest.mark.parametrize("mode", ["SameStep", "NextStep", "Disabled"])
def test_step_with_tensors_does_not_wait_for_the_device(mode: str) -> None:
    envs = GymnasiumVectorEnv(Full, N, torch=True, autoreset_mode=mode, device=CUDA)
    envs.reset(seed=0)
    action = torch.zeros(N, 3, device=CUDA)
    mask = torch.ones(N, dtype=torch.bool, device=CUDA)
    for _ in range(3):  # the first calls load kernels and capture graphs
        envs.step(action)
        envs.reset(options={"reset_mask": mask})
    with nothing_waits():
        for _ in range(30):
            obs, *_ = envs.step(action)
        envs.reset(options={"reset_mask": mask})
    assert obs["policy"].device == torch.device(CUDA)


def test_stable_baselines3_receives_numpy_arrays() -> None:
    pytest.importorskip("stable_baselines3")
    from lyceum_warp.adapters import StableBaselines3VecEnv

    env = StableBaselines3VecEnv(Full, N, device=CUDA)
    env.reset()
    for _ in range(25):
        obs, reward, done, infos = env.step(np.zeros((N, 3), dtype=np.float32))
        assert isinstance(obs, np.ndarray) and isinstance(reward, np.ndarray)
        assert all(bool(info) == end for info, end in zip(infos, done, strict=True))
