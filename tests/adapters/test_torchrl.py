from typing import Any

import pytest
import torch
from full_task import Full

import lyceum_warp as lw
from lyceum_warp.gym import GymnasiumVectorEnv

N = 4


@pytest.mark.parametrize("tensors", [False, True], ids=["numpy", "torch"])
@pytest.mark.parametrize("mode, task", [("Disabled", Full), ("SameStep", "hopper")], ids=["Disabled", "SameStep"])
def test_rollout_returns_the_values_of_the_wrapped_environment(mode: str, tensors: bool, task: Any) -> None:
    """TorchRL 0.14 supports observation groups and nested infos only in the autoreset mode DISABLED."""
    from torchrl.envs.libs.gym import GymWrapper
    from torchrl.envs.utils import check_env_specs

    worlds = GymnasiumVectorEnv(task, N, autoreset_mode=mode, torch=tensors)
    env, twin = GymWrapper(worlds, convert_actions_to_numpy=not tensors), lw.make(task, nworld=N)
    check_env_specs(env)
    key, group = ("critic", "critic") if task is Full else ("observation", "policy")
    torch.manual_seed(0)
    data = env.rollout(45, break_when_any_done=False, auto_reset=False, tensordict=env.reset(seed=5))
    twin.rand_reset(5)
    ends = 0
    for t in range(45):
        step = data[:, t]
        torch.testing.assert_close(step[key], twin.obs_groups[group], rtol=0, atol=0)
        twin.step(step["action"])
        torch.testing.assert_close(step["next", "reward"][:, 0], twin.reward, rtol=0, atol=0)
        assert torch.equal(step["next", "terminated"][:, 0], twin.terminated)
        done = step["next", "done"][:, 0]
        assert torch.equal(done, twin.done)
        final = twin.final_obs_groups[group]
        torch.testing.assert_close(step["next", key][done], final[done], rtol=0, atol=0)
        ends += done.sum()
    assert ends >= N
