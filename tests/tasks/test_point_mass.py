import numpy as np
import torch
from checks import check_formula, check_uniform, positions, put_at_random
from conftest import SharedEnv

import lyceum_warp as lw

NWORLD = 256


def test_task_functions_equal_the_formulas_of_lyceum(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass", nworld=NWORLD, autoreset=False)
    rng = np.random.default_rng(0)
    for size in (1.3, 1.3, 0.08):
        put_at_random(env, rng, position=size, velocity=2.0)
        env.step(torch.from_numpy(rng.uniform(-1.5, 1.5, (NWORLD, 2)).astype(np.float32)))
        qpos, qvel = positions(env)
        distance = np.linalg.norm(qpos[:, :2] - qpos[:, 2:], axis=1)
        check_formula(env.obs, np.concatenate([qpos[:, :2], qvel[:, :2], qpos[:, 2:]], axis=1))
        check_formula(env.reward, 1.0 - distance)
        check_formula(env.eval, distance)
        assert np.array_equal(env.success.numpy(), distance < 0.05)
        assert not env.terminated.any()
    assert 10 < env.success.sum() < NWORLD - 10


def test_action_accelerates_only_the_agent(shared_env: SharedEnv) -> None:
    """The acceleration is gear / (mass + armature)."""
    env = shared_env("point_mass", nworld=2, autoreset=False)
    env.reset()
    assert env.model.opt.timestep == env.timestep == 0.02
    assert not env.model.opt.gravity.any()
    assert np.array_equal(env.model.jnt_range, np.tile([-1.4, 1.4], (4, 1)))
    env.step(torch.tensor([[1.0, 0.0], [0.0, -3.0]]))  # -3 is clipped to -1
    qpos, qvel = positions(env)
    # semi-implicit Euler step from rest, with implicit damping of 0.1
    speed = 0.02 * 4.0 / (0.3 + 0.01 + 0.02 * 0.1)
    np.testing.assert_allclose(qvel, [[speed, 0, 0, 0], [0, -speed, 0, 0]], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(qpos, [[0.02 * speed, 0, 1, 0], [0, -0.02 * speed, 1, 0]], rtol=1e-6, atol=1e-9)


def test_random_resets_place_agent_and_target_within_the_square() -> None:
    env = lw.make("point_mass", engine="mujoco", nworld=2000)
    env.rand_reset(0)
    qpos, qvel = positions(env)
    check_uniform(qpos)
    assert not qvel.any()
    env.reset()
    qpos, qvel = positions(env)
    assert np.array_equal(qpos, np.tile([0.0, 0.0, 1.0, 0.0], (2000, 1)))
    assert not qvel.any()
