"""Provide Warp functions for the velocities of bodies."""

import warp as wp


@wp.func
def body_velocity(cvel: wp.spatial_vector, com: wp.vec3, point: wp.vec3) -> wp.spatial_vector:
    """Return the velocity of a body at a point, as (angular, linear) in the world's axes, in rad/s and m/s.

    The result is (w, v + w x (point - com)) for cvel = (w, v), as mj_objectVelocity computes it in the world's axes.

    Args:
        cvel: The body's row of ``cvel``, (angular, linear), at the centre of mass of its kinematic tree.
        com: The centre of mass of the kinematic tree: the root body's row of ``subtree_com``.
        point: A point of the body, in the world's frame, such as the body's row of ``xpos`` or ``xipos``.
    """
    w = wp.spatial_top(cvel)
    return wp.spatial_vector(w, wp.spatial_bottom(cvel) + wp.cross(w, point - com))
