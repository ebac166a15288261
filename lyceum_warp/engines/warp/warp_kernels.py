"""Define kernels of the Warp engine. They copy worlds into a group and back, place static geoms, and correct constants.

Each masked world gets a number from 0, called its rank. The order of the ranks is arbitrary. A group holds the worlds
with consecutive ranks, beginning with rank ``first``.
"""

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
    """Compute world poses of the listed geoms in the masked worlds; launched over (nworld, geoms)."""
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


@wp.kernel(enable_backward=False)
def find_any(mask_in: wp.array[bool], any_out: wp.array[int]):
    """Set an array's single element to 1 unless the mask is empty; launched over (nworld,)."""
    w = wp.tid()
    if mask_in[w]:
        any_out[0] = 1


@wp.kernel(enable_backward=False)
def rank_worlds(mask_in: wp.array[bool], rank_out: wp.array[int], count_inout: wp.array[int]):
    """Give each masked world a number, from 0 and in any order; launched over (nworld,)."""
    w = wp.tid()
    if mask_in[w]:
        rank_out[w] = wp.atomic_add(count_inout, 0, 1)


@wp.kernel(enable_backward=False)
def next_group(count_in: wp.array[int], step: int, first_inout: wp.array[int], left_out: wp.array[int]):
    """Skip ``step`` worlds to start the next group, and count the worlds that remain; launched over (1,)."""
    first = first_inout[0] + step
    first_inout[0] = first
    left_out[0] = wp.max(0, count_in[0] - first)


@wp.kernel(enable_backward=False)
def choose_group(mask_in: wp.array[bool], rank_in: wp.array[int], first_in: wp.array[int], world_out: wp.array[int]):
    """Choose the worlds of the current group, one for each of its rows; launched over (nworld,)."""
    w = wp.tid()
    if mask_in[w]:
        place = rank_in[w] - first_in[0]
        if place >= 0 and place < world_out.shape[0]:
            world_out[place] = w


@wp.kernel(enable_backward=False)
def take_rows(
    world_in: wp.array[int], left_in: wp.array[int], source_in: wp.array2d[float], target_out: wp.array2d[float]
):
    """Copy the rows of a group's worlds into the group; launched over (group size, row length)."""
    place, i = wp.tid()
    if place < left_in[0]:
        target_out[place, i] = source_in[world_in[place], i]


@wp.kernel(enable_backward=False)
def return_rows(
    world_in: wp.array[int], left_in: wp.array[int], source_in: wp.array2d[float], target_out: wp.array2d[float]
):
    """Copy the rows of a group back to its worlds; launched over (group size, row length)."""
    place, i = wp.tid()
    if place < left_in[0]:
        target_out[world_in[place], i] = source_in[place, i]


@wp.kernel(enable_backward=False)
def return_bits(world_in: wp.array[int], left_in: wp.array[int], source_in: wp.array[int], target_inout: wp.array[int]):
    """Copy the set bits of each row to its world, with a bitwise OR; launched over (group size,)."""
    place = wp.tid()
    if place < left_in[0]:
        world = world_in[place]
        target_inout[world] = target_inout[world] | source_in[place]


@wp.kernel(enable_backward=False)
def mark_changed(
    mask_in: wp.array[bool], given_in: wp.array2d[int], applied_inout: wp.array2d[int], changed_inout: wp.array[bool]
):
    """Mark the masked worlds whose bits have changed, and store the new bits; launched over (nworld,)."""
    w = wp.tid()
    if mask_in[w]:
        for i in range(given_in.shape[1]):
            bits = given_in[w, i]
            if bits != applied_inout[w, i]:
                applied_inout[w, i] = bits
                changed_inout[w] = True


@wp.kernel(enable_backward=False)
def correct_weights(
    weighs_in: wp.array[wp.vec2],
    sliding_in: wp.array[bool],
    dofadr_in: wp.array[int],
    dofnum_in: wp.array[int],
    mass_in: wp.array2d[float],
    body_inout: wp.array2d[wp.vec2],
    dof_inout: wp.array2d[float],
):
    """Correct inverse weights so that they match mj_setConst's; launched over (nworld, nbody).

    If the translational or the rotational weight is 0, MuJoCo Warp replaces it by the other weight. If a simple body
    only slides, its weight should be 1 / mass, but MuJoCo Warp lacks this special case.
    """
    w, body = wp.tid()
    if sliding_in[body]:
        weight = 1.0 / mass_in[w % mass_in.shape[0], body]
        body_inout[w, body] = wp.vec2(weight, 0.0)
        for i in range(dofadr_in[body], dofadr_in[body] + dofnum_in[body]):
            dof_inout[w, i] = weight
    elif body_inout[w, body][0] == body_inout[w, body][1]:
        body_inout[w, body] = wp.cw_mul(body_inout[w, body], weighs_in[body])
