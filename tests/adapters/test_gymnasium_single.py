import warnings

import gymnasium
import numpy as np
import pytest
import torch
from full_task import Full
from gymnasium.utils.env_checker import check_env

import lyceum_warp as lw
from lyceum_warp.gym import GymnasiumEnv
from lyceum_warp.viz.video import NoVideoError

THEIRS = ("is -infinity. This is probably too low", "is infinity. This is probably too high")
"""Gymnasium's own environments cause these warnings, too, because their observations are unbounded."""


def test_gymnasium_env_checker_accepts_the_adapter() -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(GymnasiumEnv(Full), skip_render_check=True)
        try:
            check_env(gymnasium.make("lyceum_warp.gym:lyceum/Hopper-v0").unwrapped)
        except NoVideoError as error:
            pytest.skip(str(error))
    said = [str(warning.message) for warning in caught]
    assert not [text for text in said if not any(known in text for known in THEIRS)]


def test_step_returns_the_values_of_the_wrapped_environment() -> None:
    env, twin = GymnasiumEnv(Full), lw.make(Full, autoreset=False)
    obs, info = env.reset(seed=7)
    twin.rand_reset(7)
    rng = np.random.default_rng(0)
    for _ in range(20):
        assert env.observation_space.contains(obs)
        np.testing.assert_array_equal(obs["critic"], twin.obs_groups["critic"][0].numpy())
        action = rng.uniform(-1, 1, 3).astype(np.float32)
        obs, reward, terminated, truncated, info = env.step(action)
        twin.step(torch.from_numpy(action)[None])
        assert (reward, terminated, truncated) == (twin.reward.item(), twin.terminated.item(), twin.truncated.item())
        assert info["eval"] == twin.eval.item() and info["done_reason"] == twin.done_reason.item()
        assert info["metrics"] == {name: value.item() for name, value in twin.metrics.items()}
        assert info["episode_metrics"]["cost"] == twin.episode_metrics["cost"].item()
        if terminated or truncated:
            break
    else:
        pytest.fail("no episode ended within the horizon")


def test_make_with_max_episode_steps_truncates_episodes() -> None:
    env = gymnasium.make("lyceum_warp.gym:lyceum/Hopper-v0", max_episode_steps=2)
    env.reset(seed=0)
    ends = [env.step(np.zeros(3, dtype=np.float32))[3] for _ in range(2)]
    assert ends == [False, True]
    envs = gymnasium.make_vec("lyceum_warp.gym:lyceum/Hopper-v0", num_envs=2, max_episode_steps=2)
    envs.reset(seed=0)
    ends = [envs.step(np.zeros((2, 3), dtype=np.float32))[3].all() for _ in range(2)]
    assert ends == [False, True]


def test_invalid_actions_and_reset_options_raise_an_error() -> None:
    hopper = GymnasiumEnv("hopper")
    with pytest.raises(ValueError, match=r"a float32 array of shape \(3,\), not a float64 array of shape \(2,\)"):
        hopper.step(np.zeros(2))
    with pytest.raises(ValueError, match="reset has no option 'reset_mask': call it without options"):
        hopper.reset(options={"reset_mask": [True]})
