"""Change the actuators of a model in a task's ``edit_model``."""

import math

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


def unstable_servos(model: mujoco.MjModel) -> dict[str, float]:
    """Find the position servos of joints that are unstable in the model's substep.

    A servo of stiffness k and damping d on a joint of inertia m is stable in a substep of h seconds if
    h²k/m + 2hd/m < 4, or h²k/m - 2hd/m < 4 if the integrator is implicit in the damping. The inertia is that at
    ``qpos0``, with all other joints free. The integrator ``discrete`` is stable in every substep.

    Returns:
        The longest stable substep of each of these servos in seconds, by the servo's name.
    """
    integrator, limits = mujoco.mjtIntegrator(model.opt.integrator), {}
    if integrator == mujoco.mjtIntegrator.mjINT_DISCRETE:
        return {}
    implicit = integrator in (mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    sign = -1.0 if implicit else 1.0
    for i in range(model.nu):
        _, stiffness, damping = -model.actuator_biasprm[i, :3] * model.actuator_gear[i, 0] ** 2
        if model.actuator_trntype[i] != mujoco.mjtTrn.mjTRN_JOINT or stiffness <= 0.0:
            continue
        inverse = float(model.dof_invweight0[model.jnt_dofadr[model.actuator_trnid[i, 0]]])
        k, d = stiffness * inverse, sign * damping * inverse
        longest = (math.sqrt(d * d + 4.0 * k) - d) / k if k > 0.0 else math.inf
        if longest < model.opt.timestep:
            limits[model.actuator(i).name] = longest
    return limits
