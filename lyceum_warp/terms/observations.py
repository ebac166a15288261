"""Write observations of joints, and add noise."""

import warp as wp

from lyceum_warp.core.task import Row
from lyceum_warp.kernels.random import normal, uniform


@wp.func
def gather(target: Row[float], source: Row[float], indices: wp.array[int]):
    """Copy the listed elements, such as the velocities of joints: target[i] = source[indices[i]]."""
    for i in range(indices.shape[0]):
        target[i] = source[indices[i]]


@wp.func
def gather_positions(
    target: Row[float],
    qpos: Row[float],
    joint_qpos: wp.array[int],
    default_pose: wp.array[float],
    encoder_bias: Row[float],
):
    for j in range(joint_qpos.shape[0]):
        target[j] = qpos[joint_qpos[j]] + encoder_bias[j] - default_pose[j]


@wp.func
def gather_positions(target: Row[float], qpos: Row[float], joint_qpos: wp.array[int], default_pose: wp.array[float]):
    """Write joint positions relative to the default pose, as encoders measure them: q + bias - q_0.

    If ``encoder_bias`` is not given, the bias is 0. Source: mjlab 1.6.0, ``joint_pos_rel``.
    """
    for j in range(joint_qpos.shape[0]):
        target[j] = qpos[joint_qpos[j]] - default_pose[j]


@wp.func
def add_uniform_noise(row: Row[float], noise: float, rng: Row[wp.uint32]):
    for i in range(row.shape[0]):
        row[i] = row[i] + uniform(rng, -noise, noise)


@wp.func
def add_uniform_noise(row: Row[wp.vec3], noise: float, rng: Row[wp.uint32]):
    """Add noise from U(-noise, noise) to every element of a row; the elements are numbers or vectors."""
    for i in range(row.shape[0]):
        row[i] = row[i] + uniform(rng, wp.vec3(-noise), wp.vec3(noise))


@wp.func
def add_normal_noise(row: Row[float], noise: float, rng: Row[wp.uint32]):
    for i in range(row.shape[0]):
        row[i] = row[i] + noise * normal(rng)


@wp.func
def add_normal_noise(row: Row[wp.vec3], noise: float, rng: Row[wp.uint32]):
    """Add noise from N(0, noise^2) to every element of a row; the elements are numbers or vectors."""
    for i in range(row.shape[0]):
        x, y, z = normal(rng), normal(rng), normal(rng)
        row[i] = row[i] + noise * wp.vec3(x, y, z)
