from pathlib import Path
from typing import Any

import pytest
import torch
from full_task import Full
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.trainers.torch import SequentialTrainer

import lyceum_warp as lw
from lyceum_warp.gym import GymnasiumVectorEnv

N = 4


class Policy(GaussianMixin, Model):
    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.net = torch.nn.Linear(self.num_observations, self.num_actions)
        self.log_std = torch.nn.Parameter(torch.zeros(self.num_actions))

    def compute(self, inputs: dict[str, Any], role: str) -> tuple[torch.Tensor, dict[str, Any]]:
        return self.net(inputs["observations"]), {"log_std": self.log_std}


class Value(DeterministicMixin, Model):
    """skrl calls the critic's observation a state."""

    def __init__(self, **spaces: Any) -> None:
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.name = "states" if self.num_states else "observations"
        self.net = torch.nn.Linear(self.num_states or self.num_observations, 1)

    def compute(self, inputs: dict[str, Any], role: str) -> tuple[torch.Tensor, dict[str, Any]]:
        return self.net(inputs[self.name]), {}


def wrapped(*, tensors: bool) -> Any:
    """skrl's wrapper for Isaac Lab accepts torch tensors."""
    if not tensors:
        return wrap_env(GymnasiumVectorEnv("hopper", N), verbose=False)
    env = GymnasiumVectorEnv(Full, N, torch=True, dict_obs=True)
    return wrap_env(env, wrapper="isaaclab-single-agent", verbose=False)


def test_skrl_wrapper_returns_tensors_unchanged() -> None:
    env, twin = wrapped(tensors=True), lw.make(Full, nworld=N)
    env.unwrapped.reset(seed=3)
    env.reset()
    env.unwrapped.reset(seed=3)
    twin.rand_reset(3)
    assert env.observation_space.shape == (3,) and env.state_space.shape == (15,) and env.device == torch.device("cpu")
    for _ in range(25):
        action = 2 * torch.rand(N, 3) - 1
        obs, reward, terminated, truncated, info = env.step(action)
        twin.step(action)
        assert torch.equal(obs, twin.obs) and torch.equal(env.state(), twin.obs_groups["critic"])
        assert torch.equal(reward[:, 0], twin.reward) and torch.equal((terminated | truncated)[:, 0], twin.done)
        assert torch.equal(info["final_obs"]["policy"], twin.final_obs)


@pytest.mark.parametrize("tensors", [False, True], ids=["gymnasium", "isaaclab"])
def test_ppo_trains(tensors: bool, tmp_path: Path) -> None:
    env = wrapped(tensors=tensors)
    spaces = {"observation_space": env.observation_space, "state_space": env.state_space, "device": env.device}
    spaces["action_space"] = env.action_space
    models = {"policy": Policy(**spaces), "value": Value(**spaces)}
    memory = RandomMemory(memory_size=16, num_envs=N, device=env.device)
    config = PPO_CFG(rollouts=16, learning_epochs=2)
    config.experiment.directory, config.experiment.write_interval = str(tmp_path), 0
    config.experiment.checkpoint_interval = 0
    agent = PPO(models=models, memory=memory, cfg=config, **spaces)
    before = [parameter.clone() for parameter in models["policy"].parameters()]
    options = {"timesteps": 64, "headless": True, "disable_progressbar": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=options).train()
    after = list(models["policy"].parameters())
    assert all(torch.isfinite(p).all() for p in after)
    assert any((a != b).any() for a, b in zip(before, after, strict=True))
