import gymnasium
import numpy as np
import pytest
import torch
from full_task import Full
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.monitor import Monitor

import lyceum_warp as lw
from lyceum_warp.adapters import StableBaselines3VecEnv
from lyceum_warp.viz.video import NoVideoError

N = 4


@pytest.fixture(scope="module")
def full() -> StableBaselines3VecEnv:
    return StableBaselines3VecEnv(Full, N, seed=3)


def test_step_returns_the_values_of_the_wrapped_environment(full: StableBaselines3VecEnv) -> None:
    twin = lw.make(Full, nworld=N)
    full.seed(9)
    first = full.reset()
    np.testing.assert_array_equal(first, (twin.rand_reset(9), twin.obs.numpy())[1])
    rng = np.random.default_rng(0)
    returns, lengths, ends, timeouts = np.zeros(N), np.zeros(N, dtype=int), 0, 0
    for _ in range(45):
        action = rng.uniform(-1, 1, (N, 3)).astype(np.float32)
        obs, reward, done, infos = full.step(action)
        twin.step(torch.from_numpy(action))
        np.testing.assert_array_equal(obs, twin.obs.numpy())
        np.testing.assert_array_equal(reward, twin.reward.numpy())
        np.testing.assert_array_equal(done, twin.done.numpy())
        returns, lengths = returns + reward, lengths + 1
        for world, info in enumerate(infos):
            assert bool(info) == done[world]
            if info:
                np.testing.assert_array_equal(info["terminal_observation"], twin.final_obs[world].numpy())
                assert info["TimeLimit.truncated"] == (twin.truncated[world] & ~twin.terminated[world]).item()
                assert info["episode"]["r"] == pytest.approx(returns[world])
                assert info["episode"]["l"] == lengths[world] and info["episode"]["t"] > 0
                assert info["eval"] == twin.eval[world].item()
                assert info["is_success"] == twin.success[world].item()
                assert info["episode_metrics"]["cost"] == twin.episode_metrics["cost"][world].item()
                timeouts += info["TimeLimit.truncated"]
        returns[done], lengths[done], ends = 0, 0, ends + done.sum()
    assert ends and timeouts
    assert (full.reset() != first).any()  # the seed applies only to the first reset


def test_off_policy_learner_stores_final_observations(full: StableBaselines3VecEnv) -> None:
    model = SAC("MlpPolicy", full, learning_starts=40, batch_size=16, buffer_size=2000, seed=0, device="cpu")
    model.learn(200)
    buffer = model.replay_buffer
    assert buffer is not None and buffer.pos == 50 and buffer.timeouts[:50].any()
    ended = np.argwhere(buffer.dones[:49])
    assert len(ended)
    for step, world in ended:
        assert (buffer.next_observations[step, world] != buffer.observations[step + 1, world]).any()


def test_get_attr_set_attr_and_env_method_reach_the_worlds() -> None:
    env = StableBaselines3VecEnv("hopper", N, ctrl_cost_weight=0.5)
    assert env.get_attr("render_mode") == [None] * N and env.has_attr("timestep") and not env.has_attr("colour")
    assert env.get_attr("ctrl_cost_weight", indices=[0, 2]) == [0.5, 0.5]
    env.set_attr("ctrl_cost_weight", 0.25)
    assert env.env.given_params["ctrl_cost_weight"] == 0.25
    env.set_attr("ctrl_cost_weight", [0.0, 1.0, 2.0, 3.0])
    assert env.get_attr("ctrl_cost_weight", indices=[1, 3]) == [1.0, 3.0]
    env.reset()
    env.step(np.zeros((N, 3), dtype=np.float32))
    assert [step.item() for step in env.get_attr("episode_step", indices=[1, 3])] == [1, 1]
    assert torch.equal(env.env_method("get_eval", indices=2)[0], env.env.eval[2])
    assert env.env_is_wrapped(Monitor) == [True] * N
    assert env.env_is_wrapped(gymnasium.Wrapper, indices=[0]) == [False]
    with pytest.raises(ValueError, match="'ctrl_cost_weight' is shared by all worlds: call set_attr without indices"):
        env.set_attr("ctrl_cost_weight", 1.0, indices=[1])
    with pytest.raises(ValueError, match="'horizon' is an option, not a parameter"):
        env.set_attr("horizon", 5)
    env.set_attr("render_mode", env.render_mode)


def test_dict_obs_returns_observation_groups_as_a_dict(full: StableBaselines3VecEnv) -> None:
    assert full.observation_space.shape == (3,)
    env = StableBaselines3VecEnv(full.env, dict_obs=True)
    obs = env.reset()
    assert obs["critic"].shape == (N, 15) and env.observation_space["critic"].shape == (15,)
    model = PPO("MultiInputPolicy", env, n_steps=25, batch_size=50, n_epochs=1, device="cpu")
    model.learn(100)


def test_rendered_image_shows_all_worlds() -> None:
    env = StableBaselines3VecEnv("hopper", N, render_mode="rgb_array", render_size=(64, 48))
    try:
        assert env.render().shape == (2 * 48, 2 * 64, 3)
    except NoVideoError as error:
        pytest.skip(str(error))
    finally:
        env.close()


def test_reset_options_raise_an_error(full: StableBaselines3VecEnv) -> None:
    env = StableBaselines3VecEnv(full.env)
    env.set_options({"mask": 1})
    with pytest.raises(ValueError, match="reset has no option 'mask': do not call set_options"):
        env.reset()
