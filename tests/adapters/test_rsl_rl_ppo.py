"""What PPO takes for the rest of an episode that was cut off."""

from typing import Any

import pytest
import torch
from conftest import SharedEnv
from metered_task import Metered
from rsl_rl.algorithms import PPO
from rsl_rl.runners import OnPolicyRunner

from lyceum_warp.adapters.rsl_rl_config import Bootstrap, RslRlConfig
from lyceum_warp.adapters.rsl_rl_env import RslRlVecEnv
from lyceum_warp.adapters.rsl_rl_ppo import FinalObservationPPO

GAMMA = 0.9


@pytest.fixture
def worlds(shared_env: SharedEnv) -> RslRlVecEnv:
    return RslRlVecEnv(shared_env(Metered, nworld=4, horizon=10))


def made(worlds: RslRlVecEnv, bootstrap: Bootstrap, **others: Any) -> PPO:
    """PPO of the class that the configuration names."""
    settings: dict[str, Any] = {"hidden": (4,), "value_hidden": (1,), "num_mini_batches": 1, "num_steps_per_env": 8}
    config = RslRlConfig(gamma=GAMMA, lam=1.0, bootstrap=bootstrap, normalize=False, **settings)
    runner = config.runner_config(worlds.env)
    for network in ("actor", "critic"):
        runner[network] |= others
    return OnPolicyRunner(worlds, runner, None, "cpu").alg


def transition(worlds: RslRlVecEnv, ppo: PPO) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """World 0 goes on, 1 reaches its time limit, 2 has a fault, 3 terminates.

    Returns the velocities before the step and at its end, and the rewards that are stored. A state's value is twice its
    velocity.
    """
    first, _, last = ppo.critic.mlp
    with torch.no_grad():
        first.weight.copy_(torch.tensor([[0.0, 1.0]]))  # of the critic's group: position, velocity
        first.bias.fill_(100.0)  # elu changes negative numbers only
        last.weight.fill_(2.0)
        last.bias.fill_(-200.0)
    env = worlds.env
    state = env.get_state()
    for part, column in {"qpos": [0, 0, 0, 5], "qvel": [1, 2, 3, 4], "step": [0, 9, 0, 0]}.items():
        state[:, env.state_space.parts[part].start] = torch.tensor(column, dtype=torch.float64)
    env.set_state(state)
    obs = worlds.get_observations()
    with torch.inference_mode():
        ppo.act(obs)
        after, reward, done, extras = worlds.step(torch.tensor([[0.5], [0.5], [torch.nan], [0.5]]))
        assert done.tolist() == [False, True, True, True]
        ppo.process_env_step(after, reward, done, extras)
    return obs["critic"][:, 1], env.final_obs_groups["critic"][:, 1], ppo.storage.rewards[0, :, 0]


def test_the_value_of_the_final_observation_stands_for_the_rest(worlds: RslRlVecEnv) -> None:
    ppo = made(worlds, "final")
    assert type(ppo) is FinalObservationPPO
    before, final, stored = transition(worlds, ppo)
    assert abs(before[1] - final[1]) > 1e-3  # the last step changed the velocity
    assert final[2] == before[2] == 3.0 and worlds.env.reward[2] == 0.0  # the last good observation
    rest = torch.tensor([0.0, GAMMA * 2 * final[1], GAMMA * 2 * 3.0, 0.0])
    torch.testing.assert_close(stored, worlds.env.reward + rest, rtol=0, atol=1e-4)


def test_rsl_rls_own_takes_the_value_before_the_step(worlds: RslRlVecEnv) -> None:
    ppo = made(worlds, "before")
    assert type(ppo) is PPO
    _, _, stored = transition(worlds, ppo)
    rest = torch.tensor([0.0, GAMMA * 2 * 2.0, GAMMA * 2 * 3.0, 0.0])
    torch.testing.assert_close(stored, worlds.env.reward + rest, rtol=0, atol=1e-4)


def test_a_constant_reward_is_worth_as_much_at_a_time_limit_as_elsewhere(shared_env: SharedEnv) -> None:
    """With a reward of 1 in each step of episodes that time limits alone end, every return is 1 / (1 - gamma)."""
    worlds = RslRlVecEnv(shared_env(Metered, nworld=4, horizon=3, far=1e3))
    ppo = made(worlds, "final")
    with torch.inference_mode():
        for parameter in ppo.critic.parameters():
            parameter.zero_()
        ppo.critic.mlp[-1].bias.fill_(1.0 / (1.0 - GAMMA))
        obs = worlds.get_observations()
        for _ in range(8):
            ppo.act(obs)
            obs, reward, done, extras = worlds.step(torch.zeros(4, 1))
            ppo.process_env_step(obs, torch.ones_like(reward), done, extras)
        ppo.compute_returns(obs)
    assert ppo.storage.dones.sum() == 8
    torch.testing.assert_close(ppo.storage.returns, torch.full((8, 4, 1), 10.0), rtol=0, atol=1e-4)


def test_a_recurrent_critic_keeps_its_hidden_state(worlds: RslRlVecEnv) -> None:
    ppo = made(worlds, "final", class_name="rsl_rl.models.RNNModel", rnn_type="gru", rnn_hidden_dim=4, rnn_num_layers=1)
    with torch.inference_mode():
        ppo.act(worlds.get_observations())
        obs, reward, done, extras = worlds.step(torch.zeros(4, 1))
        before = ppo.critic.get_hidden_state().clone()
        ppo.process_env_step(obs, reward, torch.zeros_like(done), extras)
        assert torch.equal(ppo.critic.get_hidden_state(), before)
