"""Kernels that compute the poses of geoms."""

import warp as wp

from lyceum_warp.kernels.rotations import quat_mul, quat_rotate, quat_to_mat


@wp.kernel(enable_backward=False)
def place_geoms(
    mask_in: wp.array[bool],
    geom_in: wp.array[int],
    geom_bodyid: wp.array[int],
    body_parentid: wp.array[int],
    geom_pos_in: wp.array2d[wp.vec3],
    geom_quat_in: wp.array2d[wp.vec4],
    body_pos_in: wp.array2d[wp.vec3],
    body_quat_in: wp.array2d[wp.vec4],
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
        position = body_pos_in[w % body_pos_in.shape[0], body] + quat_rotate(turn, position)
        quat = quat_mul(turn, quat)
        body = body_parentid[body]
    geom_xpos_out[w, geom] = position
    geom_xmat_out[w, geom] = quat_to_mat(wp.normalize(quat))
