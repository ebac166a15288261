"""Test panda_lift, and the reward terms of aloha_lift."""

import numpy as np
import pytest
import torch
from checks import check_uniform, positions
from conftest import SharedEnv
from lifting import follow, joints_at

import lyceum_warp as lw

ARM = [f"joint{i}" for i in range(1, 8)]


def cube(env: lw.Env) -> np.ndarray:
    return positions(env)[0][:, 9:]


def test_robot_is_a_panda_with_the_published_hand(shared_env: SharedEnv) -> None:
    model = shared_env("panda_lift").model
    assert (model.nq, model.nv, model.nu, model.na) == (16, 15, 8, 8)
    for name, mass in (("hand/hand", 0.73), ("hand/left_finger", 0.015), ("hand/right_finger", 0.015)):
        np.testing.assert_allclose(model.body(name).mass, mass)
    for name in ("hand/left_finger", "hand/right_finger"):
        np.testing.assert_allclose(model.joint(name).range, [0.0, 0.04])
    for i, name in enumerate(ARM):
        np.testing.assert_allclose(model.actuator_actrange[i], model.joint(name).range)
    np.testing.assert_allclose(model.actuator_forcerange[:7, 1], [87, 87, 87, 87, 12, 12, 12])


def test_arm_without_actions_stands_still(shared_env: SharedEnv) -> None:
    env = shared_env("panda_lift", nworld=2, autoreset=False)
    before = positions(env)[0][:, :9]
    for _ in range(50):
        env.step(torch.zeros(2, 8))
    assert np.abs(positions(env)[0][:, :9] - before).max() < 1e-3
    act = env.state_space.split(env.get_state())["act"].clone()
    env.step(torch.ones(2, 8))
    moved = env.state_space.split(env.get_state())["act"] - act
    np.testing.assert_allclose(moved[0], [0.04] * 7 + [0.004], atol=1e-6)


@pytest.mark.parametrize("physics", ["exact", "fast"])
def test_a_scripted_grasp_lifts_the_cube_in_every_world(shared_env: SharedEnv, physics: str) -> None:
    env = shared_env("panda_lift", nworld=4, autoreset=False, physics=physics)
    start, at = positions(env)[0], cube(env)
    waypoints = np.zeros((3, 4, 8))
    for world in range(4):
        yaw = 2.0 * np.arctan2(at[world, 6], at[world, 3])
        yaw -= np.round(yaw / (0.5 * np.pi)) * 0.5 * np.pi
        y, z = np.array([-np.sin(yaw), np.cos(yaw), 0.0]), np.array([0.0, 0.0, -1.0])
        axes = np.stack([np.cross(y, z), y, z], axis=1)
        for i, height in enumerate((0.12, 0.02, 0.2)):
            place = np.array([*at[world, :2], height])
            waypoints[i, world, :7] = joints_at(env.model, start[world], "hand/grip", place, axes, ARM)[:7]
            waypoints[i, world, 7] = 0.0 if i == 2 else 0.04
    above, down, up = waypoints
    closed = down * ([1] * 7 + [0])
    for targets, steps in ((above, 35), (down, 20), (closed, 12), (up, 35)):
        follow(env, targets, steps)
    assert env.success.all() and (env.eval > 0.15).all()
    # with fast physics, a cube may turn in the grip
    assert (env.reward > (6.0 if physics == "exact" else 5.5)).all() and not any(env.fault_counts.values())


@pytest.mark.parametrize(
    ("task", "effort", "height", "rest"), [("panda_lift", 0.01, 11, 0.02), ("aloha_lift", 0.005, 18, 0.0658)]
)
def test_reward_terms_lie_between_0_and_1_and_their_weighted_sum_is_the_reward(
    shared_env: SharedEnv, task: str, effort: float, height: int, rest: float
) -> None:
    env = shared_env(task, nworld=16)
    rng = np.random.default_rng(0)
    for _ in range(10):
        action = torch.from_numpy(rng.uniform(-1.0, 1.0, env.action.shape).astype(np.float32))
        env.step(action)
        terms = torch.stack([env.metrics[name] for name in ("reach", "orient", "grasp", "lift")], dim=1)
        assert (terms >= 0.0).all() and (terms <= 1.0 + 1e-6).all()
        expected = terms @ torch.tensor([1.0, 0.5, 1.0, 4.0]) - effort * (action**2).sum(dim=1)
        torch.testing.assert_close(env.reward, expected)
        np.testing.assert_allclose(env.eval, positions(env)[0][:, height] - rest, atol=1e-6)


@pytest.mark.usefixtures("freed")
def test_random_resets_change_the_position_and_yaw_of_the_cube() -> None:
    x0, x1, y0, y1 = area = np.array([0.4, 0.5, 0.0, 0.3])
    env = lw.make("panda_lift", engine="mujoco", nworld=2000, area=area)
    env.rand_reset(0)
    found = cube(env)
    yaw = 2.0 * np.arctan2(found[:, 6], found[:, 3])
    middle = [(2 * found[:, 0] - x0 - x1) / (x1 - x0), (2 * found[:, 1] - y0 - y1) / (y1 - y0), yaw / np.pi]
    check_uniform(np.stack(middle, axis=1) / (1.0 + 1e-6))
    np.testing.assert_allclose(found[:, 2], 0.0199, atol=1e-7)
    assert not found[:, 4:6].any()
    qpos, qvel = positions(env)
    np.testing.assert_allclose(qpos[:, :9], np.tile(env.model.key("start").qpos[:9], (2000, 1)), atol=1e-6)
    assert not qvel.any()
