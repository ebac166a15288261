"""Compute torques of servos and of DC motors.

Torques are constant over a step's substeps, because ``control`` runs once per step.
"""

import warp as wp


@wp.func
def servo_torque(joint_target: float, joint_position: float, joint_velocity: float, kp: float, kd: float) -> float:
    """Return the torque of a servo, kp (target - q) - kd qdot, N m."""
    return kp * (joint_target - joint_position) - kd * joint_velocity


@wp.func
def dc_motor_torque(
    torque: float, joint_velocity: float, saturation_torque: float, velocity_limit: float, effort_limit: float
) -> float:
    """Clip a torque to the range that a DC motor has at the given velocity.

    The range is max(sat (-1 - qdot / limit), -effort) <= torque <= min(sat (1 - qdot / limit), effort), with qdot
    clipped to +-limit (1 + effort / sat). ``limit`` is the motor's no-load speed, above which the motor brakes. Source:
    mjlab 1.6.0, ``dc_motor_clip``.
    """
    corner = velocity_limit * (1.0 + effort_limit / saturation_torque)
    slope = wp.clamp(joint_velocity, -corner, corner) / velocity_limit
    highest = wp.min(saturation_torque * (1.0 - slope), effort_limit)
    lowest = wp.max(saturation_torque * (-1.0 - slope), -effort_limit)
    return wp.clamp(torque, lowest, highest)
