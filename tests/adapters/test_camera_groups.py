import numpy as np
import pytest

import lyceum_warp as lw

gymnasium = pytest.importorskip("gymnasium")

from lyceum_warp.adapters import GymnasiumVectorEnv  # noqa: E402

SIDE = [lw.Camera("side", 16, 12)]


def test_gymnasium_gets_pictures_and_final_pictures_as_bytes() -> None:
    env = GymnasiumVectorEnv("cartpole", 2, cameras=SIDE, max_episode_steps=40)
    space = env.single_observation_space["camera"]
    assert (space.shape, space.dtype, space.low.min(), space.high.max()) == ((12, 16, 3), np.uint8, 0, 255)
    obs, _ = env.reset(seed=1)
    assert obs in env.observation_space and obs["camera"].std() > 0
    for _ in range(40):
        obs, _, _, truncated, infos = env.step(np.ones((2, 1), dtype=np.float32))
    assert truncated.all() and obs in env.observation_space
    assert all(final in env.single_observation_space for final in infos["final_obs"])
    assert (infos["final_obs"][0]["camera"] != obs["camera"][0]).any()


def test_rsl_rl_gets_pictures() -> None:
    pytest.importorskip("rsl_rl")
    from lyceum_warp.adapters import RslRlVecEnv

    env = RslRlVecEnv("cartpole", 2, cameras=SIDE)
    assert env.get_observations()["camera"].shape == (2, 12, 16, 3)
