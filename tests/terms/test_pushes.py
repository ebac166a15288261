"""Test that pushes change velocities in the world's axes."""

import mujoco
import numpy as np
from checks import check_uniform
from term_calls import N, call


def test_push_adds_uniform_velocities_along_world_axes() -> None:
    """MuJoCo stores a free joint's angular velocity in the body's axes."""
    rng = np.random.default_rng(0)
    qpos, qvel = rng.standard_normal((N, 9)), rng.standard_normal((N, 8))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    velocity, spin = np.array([0.5, 0.4, 0.2]), np.array([0.1, 0.2, 0.7])
    change = call("push", qpos=qpos, qvel=qvel, push_velocity=velocity, push_spin=spin).after["qvel"] - qvel
    assert np.abs(change[:, 6:]).max() < 1e-6
    turned = np.zeros((N, 3))
    for world in range(N):
        mujoco.mju_rotVecQuat(turned[world], change[world, 3:6], qpos[world, 3:7])
    check_uniform(np.clip(np.hstack([change[:, :3] / velocity, turned / spin]), -1.0, 1.0))
    assert np.abs(turned / spin).max() < 1.0 + 1e-4
