import mujoco
import numpy as np
import pytest
import torch
from checks import check_formula, check_normal, check_uniform, positions, put_at_random
from conftest import SharedEnv

import lyceum_warp as lw

NWORLD = 256


def tolerance(x: np.ndarray, margin: float, value_at_margin: float = 0.1) -> np.ndarray:
    """Compute dm_control's ``tolerance`` with bounds of zero and a quadratic sigmoid."""
    scaled = np.abs(x) / margin * np.sqrt(1.0 - value_at_margin)
    return np.where(scaled < 1.0, 1.0 - scaled**2, 0.0)


def pole_direction(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    data, matrices = mujoco.MjData(model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        matrices.append(data.body("pole").xmat.reshape(3, 3).copy())
    return np.array(matrices)[:, 2, 2], np.array(matrices)[:, 0, 2]


def cartpole_reward(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, action: np.ndarray) -> np.ndarray:
    upright = (pole_direction(model, qpos)[0] + 1.0) / 2.0
    centred = (1.0 + tolerance(qpos[:, 0], margin=2.0)) / 2.0
    small_control = (4.0 + tolerance(action[:, 0], margin=1.0, value_at_margin=0.0)) / 5.0
    small_velocity = (1.0 + tolerance(qvel[:, 1], margin=5.0)) / 2.0
    return upright * centred * small_control * small_velocity


def test_task_functions_equal_the_formulas_of_lyceum(shared_env: SharedEnv) -> None:
    env = shared_env("cartpole_swingup", nworld=NWORLD, autoreset=False)
    rng = np.random.default_rng(0)
    for _ in range(5):
        put_at_random(env, rng, position=3.0, velocity=6.0)
        action = torch.from_numpy(rng.uniform(-1.5, 1.5, (NWORLD, 1)).astype(np.float32))
        env.step(action)
        qpos, qvel = positions(env)
        zz, xz = pole_direction(env.model, qpos)
        expected = cartpole_reward(env.model, qpos, qvel, action.numpy().astype(np.float64))
        assert (np.abs(qpos[:, 0]) > 2.1).any() and (np.abs(qvel[:, 1]) > 5.3).any()
        check_formula(env.reward, expected)
        check_formula(env.eval, zz)
        check_formula(env.obs, np.stack([qpos[:, 0], zz, xz, qvel[:, 0], qvel[:, 1]], axis=1))
        assert not env.terminated.any()


@pytest.mark.parametrize(("task", "sparse"), [("dm/cartpole_balance", False), ("dm/cartpole_balance_sparse", True)])
def test_cartpole_moves_and_is_rewarded_as_in_the_suite_of_dm_control(
    shared_env: SharedEnv, task: str, sparse: bool
) -> None:
    ours = shared_env("cartpole", nworld=NWORLD, autoreset=False, sparse=sparse)
    theirs = shared_env(task, nworld=NWORLD, autoreset=False)
    rng, rewards = np.random.default_rng(0), []
    for position, velocity in ((0.3, 1.0), (3.0, 8.0)):
        theirs.set_state(put_at_random(ours, rng, position=position, velocity=velocity))
        action = torch.from_numpy(rng.uniform(-1.5, 1.5, (NWORLD, 1)).astype(np.float32))
        for env in (ours, theirs):
            env.step(action)
        torch.testing.assert_close(ours.obs, theirs.obs, rtol=1e-6, atol=2e-6)
        torch.testing.assert_close(ours.reward, theirs.reward, rtol=0.0, atol=2e-6)
        assert not ours.terminated.any()
        assert not sparse or torch.equal(ours.success, theirs.reward == 1.0)
        rewards.append(theirs.reward.clone())
    assert np.ptp(torch.cat(rewards).numpy()) > 0.7


def test_random_resets_add_normal_noise_to_the_hanging_pole() -> None:
    env = lw.make("cartpole_swingup", engine="mujoco", nworld=2000, reset_noise_scale=0.3)
    env.rand_reset(0)
    qpos, qvel = positions(env)
    check_normal(np.concatenate([qpos - (0.0, np.pi), qvel], axis=1) / 0.3)
    env.reset()
    qpos, qvel = positions(env)
    np.testing.assert_allclose(qpos, np.tile([0.0, np.pi], (2000, 1)), atol=1e-6)
    assert not qvel.any()


def test_resets_of_cartpole_start_with_a_nearly_upright_pole() -> None:
    env = lw.make("cartpole", engine="mujoco", nworld=2000)
    env.rand_reset(0)
    qpos, qvel = positions(env)
    check_uniform(qpos / np.float32([0.1, 0.034]) / (1.0 + 1e-6))
    check_normal(qvel / 0.01)
    env.reset()
    assert not np.any(positions(env))
