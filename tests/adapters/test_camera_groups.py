import warnings

import numpy as np
import pytest
import torch

import lyceum_warp as lw

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from lyceum_warp.adapters import GymnasiumEnv, GymnasiumVectorEnv  # noqa: E402

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


def test_single_worlds_with_pictures_pass_gymnasiums_check() -> None:
    cameras = [*SIDE, *(lw.Camera("side", 16, 12, kind, kind) for kind in ("depth", "segmentation"))]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*A Box observation space m")  # numbers and distances have no bounds
        check_env(GymnasiumEnv("cartpole", cameras=cameras), skip_render_check=True)


@pytest.mark.parametrize("policy", ["CnnPolicy", "MultiInputPolicy"])
def test_networks_of_stable_baselines3_learn_from_pictures(policy: str) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    from lyceum_warp.adapters import StableBaselines3VecEnv

    cameras = [lw.Camera("side", 36, 36), *([lw.Camera("side", 36, 36, "depth", "depth")] * (policy != "CnnPolicy"))]
    env = StableBaselines3VecEnv("cartpole", 2, dict_obs=True, cameras=cameras, horizon=5)
    if policy == "CnnPolicy":  # needs a single picture
        env = sb3.common.vec_env.VecExtractDictObs(env, "camera")
    model = sb3.PPO(policy, env, n_steps=8, batch_size=16, n_epochs=1, device="cpu", seed=0)
    convolution = next(each for each in model.policy.modules() if isinstance(each, torch.nn.Conv2d))
    before = convolution.weight.detach().clone()
    model.learn(16)
    assert convolution.in_channels == 3 and (convolution.weight != before).any()
    assert {type(each).__name__ for each in model.policy.modules()} >= {"NatureCNN"}


def test_rsl_rl_gets_pictures() -> None:
    pytest.importorskip("rsl_rl")
    from lyceum_warp.adapters import RslRlVecEnv

    env = RslRlVecEnv("cartpole", 2, cameras=SIDE)
    assert env.get_observations()["camera"].shape == (2, 12, 16, 3)
