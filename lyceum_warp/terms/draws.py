"""Draw random numbers, and randomize model fields in each world.

Functions that scale or shift a model field start from its current value. In ``startup`` and ``randomize``, this is the
nominal value, because a reset restores the field first.
"""

import warp as wp

from lyceum_warp.core.fields import vec10
from lyceum_warp.core.task import Row
from lyceum_warp.kernels.random import uniform


@wp.func
def log_uniform(rng: Row[wp.uint32], low: float, high: float) -> float:
    """Draw exp(U(log low, log high)), so that all orders of magnitude are equally likely."""
    return wp.exp(uniform(rng, wp.log(low), wp.log(high)))


@wp.func
def uniform_int(rng: Row[wp.uint32], least: int, most: int) -> int:
    """Draw an integer n from U{least, ..., most}."""
    return least + wp.min(int(uniform(rng, 0.0, float(most - least + 1))), most - least)


@wp.func
def chosen(rng: Row[wp.uint32], share: float) -> bool:
    """Return True with the given probability, and otherwise False."""
    return uniform(rng, 0.0, 1.0) < share


@wp.func
def draw_row(row: Row[float], low: float, high: float, rng: Row[wp.uint32]):
    """Draw every element of a row, such as the encoder biases, from U(low, high)."""
    for i in range(row.shape[0]):
        row[i] = uniform(rng, low, high)


@wp.func
def scale_elements(row: Row[float], indices: wp.array[int], scale: wp.vec2, rng: Row[wp.uint32]):
    """Multiply each listed element, for example of ``dof_armature``, by its own factor from U(scale[0], scale[1])."""
    for i in range(indices.shape[0]):
        row[indices[i]] = row[indices[i]] * uniform(rng, scale[0], scale[1])


@wp.func
def draw_friction(
    geom_friction: Row[wp.vec3],
    geoms: wp.array[int],
    sliding_friction: wp.vec2,
    spinning_friction: wp.vec2,
    rolling_friction: wp.vec2,
    rng: Row[wp.uint32],
):
    """Draw friction coefficients that all listed geoms share.

    The sliding friction is drawn by ``uniform``, the spinning and the rolling friction by ``log_uniform``.
    """
    sliding = uniform(rng, sliding_friction[0], sliding_friction[1])
    spinning = log_uniform(rng, spinning_friction[0], spinning_friction[1])
    rolling = log_uniform(rng, rolling_friction[0], rolling_friction[1])
    for i in range(geoms.shape[0]):
        geom_friction[geoms[i]] = wp.vec3(sliding, spinning, rolling)


@wp.func
def scale_mass(
    body_mass: Row[float], body_inertia: Row[wp.vec3], bodies: wp.array[int], scale: wp.vec2, rng: Row[wp.uint32]
):
    """Multiply the mass and the inertia of each listed body by a factor from U(scale[0], scale[1])."""
    for i in range(bodies.shape[0]):
        factor = uniform(rng, scale[0], scale[1])
        body_mass[bodies[i]] = factor * body_mass[bodies[i]]
        body_inertia[bodies[i]] = factor * body_inertia[bodies[i]]


@wp.func
def shift_center_of_mass(body_ipos: Row[wp.vec3], body: int, offset: wp.vec3, rng: Row[wp.uint32]):
    """Add U(-offset, offset) to a body's centre of mass, in the body's axes, m."""
    body_ipos[body] = body_ipos[body] + uniform(rng, -offset, offset)


@wp.func
def scale_gains(
    actuator_gainprm: Row[vec10],
    actuator_biasprm: Row[vec10],
    actuators: wp.array[int],
    kp_scale: wp.vec2,
    kd_scale: wp.vec2,
    rng: Row[wp.uint32],
):
    """Multiply kp and kd of each listed position servo by two factors, each from its own range."""
    for i in range(actuators.shape[0]):
        kp = uniform(rng, kp_scale[0], kp_scale[1])
        kd = uniform(rng, kd_scale[0], kd_scale[1])
        gain, bias = actuator_gainprm[actuators[i]], actuator_biasprm[actuators[i]]
        gain[0] = kp * gain[0]
        bias[1] = kp * bias[1]
        bias[2] = kd * bias[2]
        actuator_gainprm[actuators[i]] = gain
        actuator_biasprm[actuators[i]] = bias
