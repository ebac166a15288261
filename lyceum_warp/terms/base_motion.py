"""Compute reward terms for the motion of a floating base: its velocity, orientation and height.

The free joint of the base is the first joint of the model. For a different base, define your own ``gravity``,
``linear_velocity``, ``angular_velocity``, ``base_height`` and ``heading``.
"""

import warp as wp

from lyceum_warp.core.task import Row
from lyceum_warp.kernels.rotations import quat_rotate, quat_rotate_inverse


@wp.func
def orientation(qpos: Row[float]) -> wp.vec4:
    """Return the orientation of the base, a quaternion (w, x, y, z)."""
    return wp.vec4(qpos[3], qpos[4], qpos[5], qpos[6])


@wp.func
def gravity(qpos: Row[float]) -> wp.vec3:
    """Return the direction of gravity in the base's axes, a unit vector, which is (0, 0, -1) for an upright base."""
    return quat_rotate_inverse(orientation(qpos), wp.vec3(0.0, 0.0, -1.0))


@wp.func
def linear_velocity(qpos: Row[float], qvel: Row[float]) -> wp.vec3:
    """Return the velocity of the base's origin in the base's axes, m/s."""
    return quat_rotate_inverse(orientation(qpos), wp.vec3(qvel[0], qvel[1], qvel[2]))


@wp.func
def angular_velocity(qvel: Row[float]) -> wp.vec3:
    """Return the angular velocity of the base in the base's axes, rad/s."""
    return wp.vec3(qvel[3], qvel[4], qvel[5])


@wp.func
def base_height(qpos: Row[float]) -> float:
    """Return the height of the base's origin in the world, m."""
    return qpos[2]


@wp.func
def heading(qpos: Row[float]) -> float:
    """Return the angle from the world's x axis to the horizontal projection of the base's x axis, rad."""
    forward = quat_rotate(orientation(qpos), wp.vec3(1.0, 0.0, 0.0))
    return wp.atan2(forward[1], forward[0])


@wp.func
def track_linear_velocity(command: wp.vec3, linear_velocity: wp.vec3, linear_velocity_variance: float) -> float:
    """Reward a robot that follows the commanded velocity and does not bounce.

    The term is exp(-(|c_xy - v_xy|^2 + v_z^2) / variance). Source: mjlab 1.6.0, ``track_linear_velocity``, with
    variance = std^2.
    """
    return wp.exp(-wp.length_sq(wp.vec3(command[0], command[1], 0.0) - linear_velocity) / linear_velocity_variance)


@wp.func
def track_angular_velocity(command: wp.vec3, angular_velocity: wp.vec3, angular_velocity_variance: float) -> float:
    """Reward a robot that follows the commanded yaw rate and does not roll or pitch.

    The term is exp(-((c_yaw - w_z)^2 + w_x^2 + w_y^2) / variance). Source: mjlab 1.6.0, ``track_angular_velocity``,
    with variance = std^2.
    """
    return wp.exp(-wp.length_sq(wp.vec3(0.0, 0.0, command[2]) - angular_velocity) / angular_velocity_variance)


@wp.func
def velocity_error(command: wp.vec3, linear_velocity: wp.vec3) -> float:
    """Return the difference between the horizontal velocity and its command, |c_xy - v_xy|, m/s."""
    return wp.length(wp.vec2(command[0] - linear_velocity[0], command[1] - linear_velocity[1]))


@wp.func
def yaw_rate_error(command: wp.vec3, angular_velocity: wp.vec3) -> float:
    """Return the difference between the yaw rate and its command, |c_yaw - w_z|, rad/s."""
    return wp.abs(command[2] - angular_velocity[2])


@wp.func
def vertical_velocity_l2(linear_velocity: wp.vec3) -> float:
    """v_z^2, (m/s)^2.

    Source: legged_gym (Rudin et al. 2022).
    """
    return linear_velocity[2] * linear_velocity[2]


@wp.func
def roll_pitch_rate_l2(angular_velocity: wp.vec3) -> float:
    """w_x^2 + w_y^2, (rad/s)^2, in the base's axes.

    Source: legged_gym (Rudin et al. 2022). mjlab's ``body_angular_velocity_penalty`` uses the world's axes.
    """
    return angular_velocity[0] * angular_velocity[0] + angular_velocity[1] * angular_velocity[1]


@wp.func
def tilt_l2(gravity: wp.vec3) -> float:
    """Return the squared sine of the base's tilt, g_x^2 + g_y^2, from 0 to 1.

    Source: mjlab 1.6.0, ``flat_orientation_l2``.
    """
    return gravity[0] * gravity[0] + gravity[1] * gravity[1]


@wp.func
def upright(gravity: wp.vec3, tilt_variance: float) -> float:
    """exp(-(g_x^2 + g_y^2) / variance).

    Source: mjlab 1.6.0, ``upright``, with variance = std^2.
    """
    return wp.exp(-tilt_l2(gravity) / tilt_variance)


@wp.func
def base_height_l2(base_height: float, target_height: float) -> float:
    """(height - target)^2, m^2."""
    return (base_height - target_height) * (base_height - target_height)


@wp.func
def alive() -> float:
    """Return 1 in every step, including the last step of an episode."""
    return 1.0


@wp.func
def fell_over(gravity: wp.vec3, fall_angle: float) -> bool:
    """Return whether the base is tilted by more than ``fall_angle``: arccos(-g_z) > fall_angle.

    Source: mjlab 1.6.0, ``bad_orientation``.
    """
    return wp.acos(wp.clamp(-gravity[2], -1.0, 1.0)) > fall_angle


@wp.func
def too_low(base_height: float, least_height: float) -> bool:
    """Return whether the base is below ``least_height``.

    Source: mjlab 1.6.0, ``root_height_below_minimum``.
    """
    return base_height < least_height
