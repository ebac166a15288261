import importlib.util

import mujoco
import numpy as np
import pytest
import torch
from checks import check_formula, check_uniform, positions
from conftest import SharedEnv

import lyceum_warp as lw

pytestmark = pytest.mark.skipif(importlib.util.find_spec("dm_control") is None, reason="dm_control brings the model")

GOAL = np.array([0.0, 0.2, 0.5])


def places(env: lw.Env, state: torch.Tensor | None = None) -> dict[str, np.ndarray]:
    data, found = mujoco.MjData(env.model), []
    for row in positions(env, state)[0]:
        data.qpos[:] = row
        mujoco.mj_kinematics(env.model, data)
        fingers = [data.geom(f"hand/finger_tip_{i}").xpos for i in (1, 2, 3)]
        found.append(np.array([data.body("table/ball").xpos, data.site("hand/pinchsite").xpos, *fingers]))
    array = np.array(found)
    return {"ball": array[:, 0], "palm": array[:, 1], "fingers": array[:, 2:]}


def reward(place: dict[str, np.ndarray]) -> np.ndarray:
    """Return Lyceum's reward with the correct goal distance."""
    ball = place["ball"]
    palm = np.minimum(np.linalg.norm(place["palm"] - ball, axis=1), 0.5) / 0.5
    goal = np.minimum(np.linalg.norm(GOAL - ball, axis=1), 0.5) / 0.5
    fingers = np.minimum(np.linalg.norm(place["fingers"] - ball[:, None], axis=2), 0.5).sum(axis=1)
    return np.where(palm < 0.06, 2.0 - 2.0 * goal - 0.1 * fingers, -palm)


def put_balls(env: lw.Env, place: np.ndarray) -> torch.Tensor:
    state = env.get_state()
    env.state_space.split(state)["qpos"][:, 9:12] = torch.from_numpy(place)
    return state


def test_arm_starts_above_the_ball_and_stands_still_with_zero_actions(shared_env: SharedEnv) -> None:
    env = shared_env("arm_hand_pickup")
    model = env.model
    assert (model.nq, model.nv, model.nu) == (16, 15, 9)
    env.reset()
    place, start = places(env), positions(env)[0]
    np.testing.assert_allclose(place["ball"], [[0, 0, 0.035]], atol=1e-6)
    assert np.abs(place["palm"][0, :2]).max() < 0.03 and place["palm"][0, 2] > 0.15
    for _ in range(50):
        env.step(torch.zeros(1, 9))
    assert np.abs(positions(env)[0][:, :9] - start[:, :9]).max() < 0.02
    np.testing.assert_allclose(places(env)["ball"], [[0, 0, 0.035]], atol=1e-3)
    assert env.eval.item() == pytest.approx(0.035, abs=1e-3)


def test_observation_and_reward_equal_the_formulas_of_lyceum(shared_env: SharedEnv) -> None:
    env = shared_env("arm_hand_pickup", nworld=64, autoreset=False)
    rng = np.random.default_rng(0)
    state = env.get_state()
    qpos = env.state_space.split(state)["qpos"]
    qpos[:, :9] += torch.from_numpy(rng.uniform(-0.3, 0.3, (64, 9)))
    env.set_state(state)
    away = rng.normal(size=(64, 3)) * np.repeat([0.001, 0.017, 0.2, 2.0], 16)[:, None]
    env.set_state(put_balls(env, (places(env)["palm"] + away).astype(np.float32)))
    place, (qpos, qvel) = places(env), positions(env)
    ball = place["ball"]
    parts = [qpos[:, :9], qvel[:, :12], ball, place["palm"] - ball, GOAL - ball]
    check_formula(env.obs, np.concatenate([*parts, (place["fingers"] - ball[:, None]).reshape(64, 9)], axis=1))
    rewards = env.get_reward(env.get_state(), torch.zeros(64, 9), env.get_state())
    check_formula(rewards, reward(place))
    assert (rewards > 0).sum() > 4 and (rewards < -0.99).any()


@pytest.mark.usefixtures("freed")
def test_random_resets_change_the_position_of_the_ball() -> None:
    env = lw.make("arm_hand_pickup", engine="mujoco", nworld=2000)
    qpos, qvel = positions(env)
    check_uniform(qpos[:, 9:11] / np.float32([0.15, 0.1]))
    assert np.ptp(qpos[:, :9], axis=0).max() == 0 and not qvel.any()


def test_task_succeeds_after_a_fifth_of_a_second_at_the_goal(shared_env: SharedEnv) -> None:
    """A step moves the ball by millimetres, so the test moves it back before each step."""
    env = shared_env("arm_hand_pickup", nworld=2, autoreset=False)
    for i in range(10):
        assert not env.success.any(), i
        state = put_balls(env, GOAL + np.array([[0.0, 0.0, 0.02], [0.0, 0.07, 0.0]]))
        env.state_space.split(state)["qvel"].zero_()
        env.set_state(state)
        env.step(torch.zeros(2, 9))
    assert env.success.tolist() == [True, False]
