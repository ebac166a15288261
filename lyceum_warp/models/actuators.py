"""Change the actuators of a model in a task's ``edit_model``."""

import mujoco

from lyceum_warp.support.validate import positive_number


def follow_velocity(actuator: mujoco.MjsActuator, speed: float) -> None:
    """Turn a position servo into an actuator whose control is the velocity of the servo's target.

    The gains do not change. The target becomes an activation of the model (``act``), which stays in the old control
    range.

    Args:
        actuator: A position servo with a control range. The function changes the servo in place.
        speed: Controls range from -speed to speed, in m/s or rad/s.

    Raises:
        ValueError: The actuator is not a position servo, has no control range, or the speed is not positive.

    Example:
        >>> for servo in spec.actuators:
        ...     lw.follow_velocity(servo, 1.0)
    """
    name, kp = f"the actuator {actuator.name!r}", actuator.gainprm[0]
    if actuator.biastype != mujoco.mjtBias.mjBIAS_AFFINE or actuator.biasprm[1] != -kp or kp <= 0.0:
        raise ValueError(f"{name} is not a position servo: define it as <position kp=...>, or call set_to_position")
    if actuator.ctrlrange[0] >= actuator.ctrlrange[1]:
        raise ValueError(f"{name} has no range for its target: set the actuator's ctrlrange first")
    speed = positive_number("speed", speed, "m/s or rad/s")
    actuator.set_to_intvelocity(kp=kp, kv=-actuator.biasprm[2])
    actuator.actrange, actuator.ctrlrange = actuator.ctrlrange, (-speed, speed)
