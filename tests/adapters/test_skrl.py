from typing import Any

import pytest
import torch
from full_task import Full
from skrl.envs.wrappers.torch import wrap_env

import lyceum_warp as lw
from lyceum_warp.gym import GymnasiumVectorEnv

N = 4


def wrapped(*, tensors: bool) -> Any:
    """skrl's wrapper for Isaac Lab accepts torch tensors."""
    env = GymnasiumVectorEnv(Full, N, torch=tensors, dict_obs=tensors)
    return wrap_env(env, wrapper="isaaclab-single-agent" if tensors else "auto", verbose=False)


@pytest.mark.parametrize("tensors", [False, True], ids=["gymnasium", "isaaclab"])
def test_skrl_wrapper_returns_the_values_of_the_wrapped_environment(tensors: bool) -> None:
    env, twin = wrapped(tensors=tensors), lw.make(Full, nworld=N)
    env.unwrapped.reset(seed=3)
    env.reset()
    env.unwrapped.reset(seed=3)
    twin.rand_reset(3)
    assert env.observation_space.shape == (3,) and env.device == torch.device("cpu")
    for _ in range(25):
        action = 2 * torch.rand(N, 3) - 1
        obs, reward, terminated, truncated, info = env.step(action)
        twin.step(action)
        assert torch.equal(obs, twin.obs) and torch.equal(reward[:, 0], twin.reward)
        assert torch.equal((terminated | truncated)[:, 0], twin.done)
        if tensors:
            assert env.state_space.shape == (15,) and torch.equal(env.state(), twin.obs_groups["critic"])
            assert torch.equal(info["final_obs"]["policy"], twin.final_obs)
