from typing import Any

import numpy as np
import pytest
import torch
from full_task import Full
from test_gpu import CUDA, nothing_waits

from lyceum_warp.adapters import StableBaselines3VecEnv
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


def test_numpy_arrays_and_tensors_have_the_same_values() -> None:
    arrays, tensors = (GymnasiumVectorEnv(Full, N, torch=t, device=CUDA, deterministic=True) for t in (False, True))
    arrays.reset(seed=3)
    tensors.reset(seed=3)
    rng, ends = np.random.default_rng(0), 0
    for _ in range(30):
        action = rng.uniform(-1, 1, (N, 3)).astype(np.float32)
        array: Any = arrays.step(action)
        tensor: Any = tensors.step(torch.from_numpy(action).to(CUDA))
        np.testing.assert_array_equal(array[0]["critic"], tensor[0]["critic"].cpu().numpy())
        for i in (1, 2, 3):
            np.testing.assert_array_equal(array[i], tensor[i].cpu().numpy())
        for world in (array[2] | array[3]).nonzero()[0]:
            final = tensor[4]["final_obs"]["critic"][world].cpu().numpy()
            np.testing.assert_array_equal(array[4]["final_obs"][world]["critic"], final)
            ends += 1
    assert ends


def test_stable_baselines3_receives_numpy_arrays() -> None:
    env = StableBaselines3VecEnv(Full, N, device=CUDA)
    env.reset()
    for _ in range(25):
        obs, reward, done, infos = env.step(np.zeros((N, 3), dtype=np.float32))
        assert isinstance(obs, np.ndarray) and isinstance(reward, np.ndarray)
        assert all(bool(info) == end for info, end in zip(infos, done, strict=True))
