"""Compute reward terms for a robot's joints: pose, limits, velocities, accelerations, torques and power.

All tables list the joints in the same order.
"""

import warp as wp

from lyceum_warp.core.task import Row
from lyceum_warp.terms.velocity_commands import command_size


@wp.func
def posture(
    qpos: Row[float], joint_qpos: wp.array[int], default_pose: wp.array[float], pose_std: wp.array[float]
) -> float:
    """Reward a pose near the default pose: exp(-mean(((q - q_0) / std)^2)), with the mean over the joints.

    Source: mjlab 1.6.0, ``posture``.
    """
    total = float(0.0)
    for j in range(joint_qpos.shape[0]):
        error = (qpos[joint_qpos[j]] - default_pose[j]) / pose_std[j]
        total += error * error
    return wp.exp(-total / float(joint_qpos.shape[0]))


@wp.func
def pose(
    command: wp.vec3,
    qpos: Row[float],
    joint_qpos: wp.array[int],
    default_pose: wp.array[float],
    standing_pose_std: wp.array[float],
    walking_pose_std: wp.array[float],
    least_command: float,
) -> float:
    """Compute ``posture`` with one table of standard deviations for standing, and another one for walking.

    The table for standing applies if ``command_size`` is below ``least_command``. Source: mjlab 1.6.0,
    ``variable_posture``, with the same table for walking and running.
    """
    if command_size(command) < least_command:
        return posture(qpos, joint_qpos, default_pose, standing_pose_std)
    return posture(qpos, joint_qpos, default_pose, walking_pose_std)


@wp.func
def pose_l2(qpos: Row[float], joint_qpos: wp.array[int], default_pose: wp.array[float]) -> float:
    """Return the sum of (q - q_0)^2 over the joints, rad^2."""
    total = float(0.0)
    for j in range(joint_qpos.shape[0]):
        error = qpos[joint_qpos[j]] - default_pose[j]
        total += error * error
    return total


@wp.func
def joint_limits(
    qpos: Row[float], joint_qpos: wp.array[int], jnt_range: Row[wp.vec2], joints: wp.array[int], soft_limit: float
) -> float:
    """Return the sum of max(|q - middle| - soft_limit * half range, 0) over the joints, rad.

    Source: mjlab 1.6.0, ``joint_pos_limits``.
    """
    outside = float(0.0)
    for j in range(joint_qpos.shape[0]):
        limits = jnt_range[joints[j]]
        middle, half = 0.5 * (limits[0] + limits[1]), 0.5 * (limits[1] - limits[0])
        outside += wp.max(wp.abs(qpos[joint_qpos[j]] - middle) - soft_limit * half, 0.0)
    return outside


@wp.func
def sum_squares_at(row: Row[float], indices: wp.array[int]) -> float:
    """Return the sum of x^2 over the listed elements of a row."""
    total = float(0.0)
    for j in range(indices.shape[0]):
        total += row[indices[j]] * row[indices[j]]
    return total


@wp.func
def joint_velocity_l2(qvel: Row[float], joint_dof: wp.array[int]) -> float:
    """Return the sum of qdot^2 over the joints, (rad/s)^2."""
    return sum_squares_at(qvel, joint_dof)


@wp.func
def joint_acceleration_l2(qacc: Row[float], joint_dof: wp.array[int]) -> float:
    """Return the sum of qddot^2 over the joints, (rad/s^2)^2."""
    return sum_squares_at(qacc, joint_dof)


@wp.func
def torque_l2(qfrc_actuator: Row[float], joint_dof: wp.array[int]) -> float:
    """Return the sum of torque^2 over the joints, (N m)^2."""
    return sum_squares_at(qfrc_actuator, joint_dof)


@wp.func
def power(qfrc_actuator: Row[float], qvel: Row[float], joint_dof: wp.array[int]) -> float:
    """Return the mechanical power without energy recovery: the sum of max(torque qdot, 0) over the joints, W.

    Source: mjlab 1.6.0, ``electrical_power_cost``.
    """
    total = float(0.0)
    for j in range(joint_dof.shape[0]):
        total += wp.max(qfrc_actuator[joint_dof[j]] * qvel[joint_dof[j]], 0.0)
    return total


@wp.func
def absolute_power(qfrc_actuator: Row[float], qvel: Row[float], joint_dof: wp.array[int]) -> float:
    """Return the mechanical power if braking costs as much as driving: the sum of |torque qdot| over the joints, W.

    Source: Fu et al. 2021, "Minimizing energy consumption leads to the emergence of gaits in legged robots".
    """
    total = float(0.0)
    for j in range(joint_dof.shape[0]):
        total += wp.abs(qfrc_actuator[joint_dof[j]] * qvel[joint_dof[j]])
    return total
