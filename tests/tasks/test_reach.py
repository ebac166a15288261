import mujoco
import numpy as np
import pytest
import torch
from checks import check_formula, check_uniform, positions, put_at_random
from conftest import SharedEnv

import lyceum_warp as lw

NWORLD = 256

RANGES = np.array([[-2.2854, 1.714602], [-0.5236, 1.3963], [-1.5, 1.7], [-2.3213, 0.0],
                   [-1.5, 1.5], [-1.094, 0.0], [-1.5, 1.5]])  # fmt: skip


def test_arm_moves_like_the_original_arm_for_three_seconds(shared_env: SharedEnv) -> None:
    model = shared_env("reach").model
    np.testing.assert_allclose(model.jnt_range, RANGES)
    data = mujoco.MjData(model)
    for i in range(300):
        data.ctrl[:] = np.sin(0.02 * i * np.arange(1, 8))
        mujoco.mj_step(model, data)
    last = [-2.28833384, -0.08709786, -1.51681723, 0.02162415, -0.11015627, -0.49795317, 1.15342769]
    np.testing.assert_allclose(data.qpos, last, atol=1e-6)


def finger(env: lw.Env, qpos: np.ndarray) -> np.ndarray:
    data, found = mujoco.MjData(env.model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(env.model, data)
        found.append(data.site("finger").xpos.copy())
    return np.array(found)


def targets(env: lw.Env) -> np.ndarray:
    return env.state_space.split(env.get_state())["mocap_pos"].numpy().copy()


def errors(env: lw.Env) -> np.ndarray:
    return finger(env, positions(env)[0]) - targets(env)


def test_task_functions_equal_the_formulas_of_lyceum(shared_env: SharedEnv) -> None:
    env = shared_env("reach", nworld=NWORLD, autoreset=False)
    rng = np.random.default_rng(0)
    assert env.obs.shape == (NWORLD, 20)
    for _ in range(3):
        put_at_random(env, rng, position=1.0, velocity=3.0)
        env.step(torch.from_numpy(rng.uniform(-1.5, 1.5, (NWORLD, 7)).astype(np.float32)))
        qpos, qvel = positions(env)
        error = errors(env)
        assert len(np.unique(np.round(error, 6), axis=0)) == NWORLD
        check_formula(env.obs, np.concatenate([qpos, qvel, finger(env, qpos), error], axis=1))
        check_formula(env.reward, -np.abs(error).sum(axis=1) - 5.0 * np.linalg.norm(error, axis=1))
        check_formula(env.eval, np.linalg.norm(error, axis=1))
        assert not env.terminated.any()


@pytest.mark.usefixtures("freed")
def test_random_resets_place_the_target_within_its_box() -> None:
    env = lw.make("reach", engine="mujoco", nworld=2000, target_range=(0.1, 0.5, 0.2))
    env.rand_reset(0)
    check_uniform(targets(env) / np.float32([0.1, 0.5, 0.2]))
    qpos, qvel = positions(env)
    assert not qpos.any() and not qvel.any()
    check_formula(env.eval, np.linalg.norm(errors(env), axis=1))
    env.reset()
    np.testing.assert_allclose(targets(env), np.full((2000, 3), 0.1), atol=1e-7)


@pytest.mark.usefixtures("freed")
def test_random_start_places_every_joint_within_its_range() -> None:
    env = lw.make("reach", engine="mujoco", nworld=2000, random_start=True)
    qpos, qvel = positions(env)
    assert not qvel.any()
    low, high = RANGES.T.astype(np.float32).astype(np.float64)
    middle = np.concatenate([(2.0 * qpos - low - high) / (high - low), targets(env) / (0.3, 0.2, 0.25)], axis=1)
    check_uniform(middle / (1.0 + 1e-6))
    for _ in range(20):
        env.step(torch.zeros(2000, 7))
    assert not env.done.any()


def put_targets(env: lw.Env, distance: np.ndarray) -> None:
    state = env.get_state()
    parts = env.state_space.split(state)
    hand = finger(env, parts["qpos"].numpy())
    parts["mocap_pos"].copy_(torch.from_numpy(hand + np.stack([distance, 0 * distance, 0 * distance], axis=1)))
    env.set_state(state)


def test_success_depends_on_the_mean_of_the_last_ten_distances(shared_env: SharedEnv) -> None:
    env = shared_env("reach", nworld=64, autoreset=False, horizon=0)
    rng = np.random.default_rng(0)
    distances: list[np.ndarray] = []
    successes = 0
    for i in range(60):
        if i % 6 == 0:
            put_targets(env, rng.uniform(0.0, 0.1, 64))
        env.step(torch.from_numpy(rng.uniform(-0.1, 0.1, (64, 7)).astype(np.float32)))
        distances.append(np.linalg.norm(errors(env), axis=1))
        mean = np.mean(distances[-10:], axis=0) if i >= 9 else np.full(64, np.inf)
        clear = np.abs(mean - 0.05) > 1e-6
        assert np.array_equal(env.success.numpy()[clear], mean[clear] < 0.05)
        successes += int(env.success.sum())
    assert 300 < successes < 51 * 64 - 300
