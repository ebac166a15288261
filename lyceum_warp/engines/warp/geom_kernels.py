"""Kernels that compute the poses of geoms."""

import warp as wp


@wp.func
def _rotated(q: wp.quat, v: wp.vec3) -> wp.vec3:
    """A vector turned by a unit quaternion (w, x, y, z)."""
    u = wp.vec3(q[1], q[2], q[3])
    return v + 2.0 * wp.cross(u, q[0] * v + wp.cross(u, v))


@wp.func
def _product(p: wp.quat, q: wp.quat) -> wp.quat:
    """The product of two quaternions (w, x, y, z)."""
    return wp.quat(
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@wp.kernel(enable_backward=False)
def place_geoms(
    mask_in: wp.array[bool],
    geom_in: wp.array[int],
    geom_bodyid: wp.array[int],
    body_parentid: wp.array[int],
    geom_pos_in: wp.array2d[wp.vec3],
    geom_quat_in: wp.array2d[wp.quat],
    body_pos_in: wp.array2d[wp.vec3],
    body_quat_in: wp.array2d[wp.quat],
    geom_xpos_out: wp.array2d[wp.vec3],
    geom_xmat_out: wp.array2d[wp.mat33],
):
    """Compute the poses of listed geoms in the masked worlds, from the world down; launched over (nworld, geoms)."""
    w, i = wp.tid()
    if not mask_in[w]:
        return
    geom = geom_in[i]
    position = geom_pos_in[w % geom_pos_in.shape[0], geom]
    quat = geom_quat_in[w % geom_quat_in.shape[0], geom]
    body = geom_bodyid[geom]
    while body > 0:
        turn = wp.normalize(body_quat_in[w % body_quat_in.shape[0], body])
        position = body_pos_in[w % body_pos_in.shape[0], body] + _rotated(turn, position)
        quat = _product(turn, quat)
        body = body_parentid[body]
    geom_xpos_out[w, geom] = position
    x, y, z = wp.vec3(1.0, 0.0, 0.0), wp.vec3(0.0, 1.0, 0.0), wp.vec3(0.0, 0.0, 1.0)
    quat = wp.normalize(quat)
    geom_xmat_out[w, geom] = wp.matrix_from_cols(_rotated(quat, x), _rotated(quat, y), _rotated(quat, z))
