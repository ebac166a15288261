"""Push a robot within an episode."""

import warp as wp

from lyceum_warp.core.task import Row
from lyceum_warp.kernels.random import uniform
from lyceum_warp.kernels.rotations import quat_rotate_inverse
from lyceum_warp.terms.base_motion import orientation


@wp.func
def push(qpos: Row[float], qvel: Row[float], push_velocity: wp.vec3, push_spin: wp.vec3, rng: Row[wp.uint32]):
    """Add random changes to the base's velocity and angular velocity; call this in ``event``.

    The changes are drawn from U(-``push_velocity``, ``push_velocity``) and U(-``push_spin``, ``push_spin``), in the
    world's axes. Source: mjlab 1.6.0, ``push_by_setting_velocity``. The base's free joint must be the model's first
    joint.
    """
    velocity = uniform(rng, -push_velocity, push_velocity)
    spin = quat_rotate_inverse(orientation(qpos), uniform(rng, -push_spin, push_spin))
    for i in range(3):
        qvel[i] = qvel[i] + velocity[i]
        qvel[3 + i] = qvel[3 + i] + spin[i]
