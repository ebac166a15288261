import math
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import SharedEnv
from metered_task import Metered
from tensordict import TensorDict

import lyceum_warp as lw
from lyceum_warp.adapters import RslRlVecEnv, runner_config


@pytest.fixture
def env(shared_env: SharedEnv) -> lw.Env:
    return shared_env(Metered, nworld=4, horizon=10, far=1e3)


def test_step_returns_all_observation_groups_without_copies(env: lw.Env) -> None:
    worlds = RslRlVecEnv(env)
    assert (worlds.num_envs, worlds.num_actions, worlds.max_episode_length) == (4, 1, 10)
    assert worlds.device == env.obs.device and worlds.cfg["task"] == "metered"
    obs, reward, done, extras = worlds.step(torch.ones(4, 1))
    assert isinstance(obs, TensorDict) and set(obs.keys()) == {"policy", "critic"}
    assert reward is env.reward and done is env.done
    assert not extras["time_outs"].any() and extras["time_outs"].dtype == torch.bool
    for group in ("policy", "critic"):
        assert torch.equal(obs[group], env.obs_groups[group])
        assert torch.equal(extras["final_obs"][group], env.final_obs_groups[group])


def test_returned_observations_are_not_overwritten_by_the_next_step(env: lw.Env) -> None:
    """rsl_rl stores the observations of a step only after the next step."""
    worlds = RslRlVecEnv(env)
    first = worlds.get_observations()
    second, *_ = worlds.step(torch.ones(4, 1))
    kept = first.clone(), second.clone()
    worlds.step(torch.ones(4, 1))
    assert not torch.equal(env.obs, second["policy"])
    for obs, before in zip((first, second), kept, strict=True):
        assert all(torch.equal(obs[group], before[group]) for group in ("policy", "critic"))


def test_setting_episode_lengths_moves_the_time_limit(env: lw.Env) -> None:
    worlds = RslRlVecEnv(env)
    worlds.episode_length_buf = torch.tensor([0, 9, 8, 3])
    *_, extras = worlds.step(torch.zeros(4, 1))
    assert extras["time_outs"].tolist() == [False, True, False, False]
    assert worlds.episode_length_buf.tolist() == [1, 0, 9, 4]
    *_, extras = worlds.step(torch.zeros(4, 1))
    assert extras["time_outs"].tolist() == [False, False, True, False]


def test_invalid_episode_lengths_raise_an_error(env: lw.Env) -> None:
    with pytest.raises(ValueError, match="from 0 to 9, not from 0 to 10"):
        RslRlVecEnv(env).episode_length_buf = torch.tensor([0, 1, 10, 2])


def test_fault_counts_as_a_time_out_but_termination_does_not(shared_env: SharedEnv) -> None:
    env = shared_env(Metered, nworld=4, horizon=10)
    worlds = RslRlVecEnv(env)
    worlds.episode_length_buf = torch.tensor([0, 0, 9, 9])
    state = env.get_state()
    state[[0, 2], env.state_space.parts["qpos"].start] = 5.0
    env.set_state(state)
    action = torch.zeros(4, 1)
    action[1] = torch.nan
    _, reward, done, extras = worlds.step(action)
    assert done.tolist() == [True, True, True, True]
    assert extras["time_outs"].tolist() == [False, True, False, True]
    assert extras["log"]["faults/worlds"] == 1
    assert reward[1] == 0.0 and extras["final_obs"]["critic"].isfinite().all()


def test_log_has_the_mean_metrics_of_recent_episodes(env: lw.Env) -> None:
    worlds = RslRlVecEnv(env)
    worlds.episode_length_buf = torch.tensor([7, 7, 5, 0])
    action = torch.tensor([[0.1], [0.2], [0.3], [0.4]])
    logs = []
    for _ in range(6):
        *_, extras = worlds.step(action)
        logs.append(extras["log"])
    assert [name for name in logs[0] if name.startswith("metrics/")] == ["metrics/forward", "metrics/effort"]
    efforts = [log["metrics/effort"].item() for log in logs]
    two = 3 * (0.01 + 0.04) / 2
    three = (3 * (0.01 + 0.04) + 5 * 0.09) / 3
    assert efforts == pytest.approx([0.0, 0.0, two, two, three, three])


def test_log_excludes_old_episodes(shared_env: SharedEnv) -> None:
    env = shared_env(Metered, nworld=4, horizon=1, far=1e3)
    worlds = RslRlVecEnv(env)
    for step in range(1, 61):
        *_, extras = worlds.step(torch.full((4, 1), 0.0 if step < 26 else 1.0))
        if step == 25:
            assert extras["log"]["metrics/effort"] == 0.0
        if step == 26:
            assert extras["log"]["metrics/effort"].item() == pytest.approx(0.04)
    assert 0.75 < extras["log"]["metrics/effort"] < 1.0
    many = RslRlVecEnv(shared_env(Metered, nworld=128, horizon=1, far=1e3))
    for action in (0.0, 1.0):
        *_, extras = many.step(torch.full((128, 1), action))
        assert extras["log"]["metrics/effort"].item() == pytest.approx(action)


def test_unsuitable_environments_raise_an_error(shared_env: SharedEnv) -> None:
    with pytest.raises(ValueError, match="the environment has autoreset=False: make it with autoreset=True"):
        RslRlVecEnv(shared_env(Metered, nworld=4, autoreset=False))
    endless = RslRlVecEnv(shared_env(Metered, nworld=2, horizon=0))
    assert endless.max_episode_length == 2**31 - 1
    with pytest.raises(ValueError, match="'metered' have no time limit, .* init_at_random_ep_len=False"):
        endless.episode_length_buf = torch.zeros(2, dtype=torch.long)


def test_rsl_rl_writer_receives_the_metrics(env: lw.Env, tmp_path: Path) -> None:
    from rsl_rl.runners import OnPolicyRunner
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    config = runner_config(env, lw.PPOConfig(hidden=(8,), value_hidden=(8,), num_steps=10))
    OnPolicyRunner(RslRlVecEnv(env), config, str(tmp_path), "cpu").learn(2)
    found = EventAccumulator(str(tmp_path)).Reload().Tags()["scalars"]
    assert {"metrics/forward", "metrics/effort", "faults/worlds", "Train/mean_reward"} <= set(found)


@pytest.mark.parametrize("changes", [{}, {"std_type": "log"}, {"normalize": False}, {"recurrent": 6}])
def test_policy_of_a_checkpoint_of_rsl_rl_acts_as_in_rsl_rl(
    changes: dict[str, Any], env: lw.Env, tmp_path: Path
) -> None:
    from rsl_rl.runners import OnPolicyRunner

    worlds, file = RslRlVecEnv(env), tmp_path / "model_1.pt"
    config = lw.PPOConfig(hidden=(8, 4), value_hidden=(8,), num_steps=10, **changes)
    runner = OnPolicyRunner(worlds, runner_config(env, config), None, "cpu")
    runner.learn(1)
    runner.save(str(file))
    with pytest.raises(ValueError) as caught:
        lw.load(file)
    own = eval(str(caught.value).partition("pass policy=")[2], {"lw": lw, "math": math})
    policy = lw.load(file, policy=own)
    obs = worlds.get_observations()
    for values in obs.values():
        values.uniform_(-30.0, 30.0)  # a limit of 10 would clip some normalised observations
    actor = runner.alg.get_policy()
    memory = torch.rand(4, policy.state_size)
    actor.reset(hidden_state=memory[None].clone())
    action = policy.act(obs["policy"], memory)[0] if policy.state_size else policy(obs["policy"])
    torch.testing.assert_close(action, actor(obs), rtol=1e-6, atol=1e-6)
    actor(obs, stochastic_output=True)
    torch.testing.assert_close(policy.log_std.exp(), actor.output_std[0])
    assert next(lw.PPO(env, policy, config=config)).samples == 40  # training continues


@pytest.mark.parametrize("name", ["rnn.rnn.weight_ih_l0", "distribution.head.weight"])
def test_other_actors_of_rsl_rl_are_refused_by_name(name: str, tmp_path: Path) -> None:
    actor = {"mlp.0.weight": torch.zeros(2, 3), "mlp.0.bias": torch.zeros(2), "distribution.std_param": torch.ones(2)}
    torch.save({"actor_state_dict": actor | {name: torch.zeros(2)}, "iter": 3}, tmp_path / "model_3.pt")
    with pytest.raises(ValueError, match=name):
        lw.load(tmp_path / "model_3.pt", policy=lw.GaussianPolicy(3, 2, ()))


@pytest.mark.gpu
def test_gpu_step_does_not_wait_for_the_device() -> None:
    env = lw.make(Metered, nworld=64, device="cuda:0")
    worlds = RslRlVecEnv(env)
    action = torch.zeros(64, 1, device="cuda:0")
    for _ in range(3):
        worlds.step(action)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(5):
            worlds.step(action)
    finally:
        torch.cuda.set_sync_debug_mode("default")
