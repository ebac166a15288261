"""Define kernels of the Warp engine.

They copy worlds into a group and back, place static geoms, correct constants, and replace wrong contacts.

Each masked world gets a number from 0, called its rank. The order of the ranks is arbitrary. A group holds the worlds
with consecutive ranks, beginning with rank ``first``.
"""

import mujoco
import warp as wp

from lyceum_warp.kernels.ground import triangle
from lyceum_warp.kernels.rotations import quat_mul, quat_rotate, quat_to_mat

HFIELD = wp.constant(int(mujoco.mjtGeom.mjGEOM_HFIELD))
SPHERE = wp.constant(int(mujoco.mjtGeom.mjGEOM_SPHERE))
MESH = wp.constant(int(mujoco.mjtGeom.mjGEOM_MESH))
CAPSULE = wp.constant(int(mujoco.mjtGeom.mjGEOM_CAPSULE))
X, Y = wp.constant(wp.vec3(1.0, 0.0, 0.0)), wp.constant(wp.vec3(0.0, 1.0, 0.0))
SEPARATE = wp.constant(1.0e6)
"""Distance in m at which no contact is active."""


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
def put_meshes(
    mask_in: wp.array[bool],
    geom_type: wp.array[int],
    mesh_in: wp.array2d[float],
    aabb_in: wp.array2d[wp.spatial_vector],
    rbound_in: wp.array2d[float],
    nmesh: int,
    dataid_out: wp.array2d[int],
    aabb_out: wp.array3d[wp.vec3],
    rbound_out: wp.array2d[float],
):
    """Set the meshes and bounds of mesh geoms in the masked worlds; launched over (nworld, ngeom).

    ``mujoco_warp.set_const`` computes the bounds of other geoms.
    """
    w, i = wp.tid()
    if mask_in[w] and geom_type[i] == MESH:
        dataid_out[w, i] = wp.clamp(int(mesh_in[w, i]), 0, nmesh - 1)
        box = aabb_in[w, i]
        aabb_out[w, i, 0] = wp.spatial_top(box)
        aabb_out[w, i, 1] = wp.spatial_bottom(box)
        rbound_out[w, i] = rbound_in[w, i]


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
    mask_in: wp.array[bool], bits_in: wp.array2d[int], applied_inout: wp.array2d[int], changed_inout: wp.array[bool]
):
    """Mark the masked worlds whose bits have changed, and store the new bits; launched over (nworld,)."""
    w = wp.tid()
    if mask_in[w]:
        for i in range(bits_in.shape[1]):
            bits = bits_in[w, i]
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


@wp.kernel(enable_backward=False)
def correct_ground_contacts(
    geom_type: wp.array[int],
    geom_dataid: wp.array2d[int],
    geom_rbound: wp.array2d[float],
    geom_size: wp.array2d[wp.vec3],
    hfield_size: wp.array[wp.vec4],
    hfield_nrow: wp.array[int],
    hfield_ncol: wp.array[int],
    hfield_adr: wp.array[int],
    hfield_data: wp.array[float],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
    nacon_in: wp.array[int],
    geom_in: wp.array[wp.vec2i],
    world_in: wp.array[int],
    dist_inout: wp.array[float],
    pos_inout: wp.array[wp.vec3],
    frame_inout: wp.array[wp.mat33],
):
    """Replace contacts with a height field that are deeper than the shapes are wide; launched over (naconmax,).

    A height field consists of prisms, whose width is at most a cell's shorter side. A geom's width is at most twice the
    radius of its bounding sphere. Spheres and capsules get the contact with the plane of the triangle below the centre
    or below an end of the axis. Other geoms get none.
    """
    i = wp.tid()
    if i >= nacon_in[0]:
        return
    w, field, geom = world_in[i], geom_in[i][0], geom_in[i][1]
    if geom_type[field] != HFIELD:
        return
    grid = geom_dataid[w % geom_dataid.shape[0], field]
    size, nrow, ncol = hfield_size[grid], hfield_nrow[grid], hfield_ncol[grid]
    dx, dy = 2.0 * size[0] / float(ncol - 1), 2.0 * size[1] / float(nrow - 1)
    if dist_inout[i] >= -2.0 * geom_rbound[w % geom_rbound.shape[0], geom] - wp.min(dx, dy):
        return
    dist_inout[i] = SEPARATE
    if geom_type[geom] != SPHERE and geom_type[geom] != CAPSULE:
        return
    shape = geom_size[w % geom_size.shape[0], geom]
    half = wp.where(geom_type[geom] == CAPSULE, shape[1], 0.0)
    mat, axis = geom_xmat[w, field], geom_xmat[w, geom] @ wp.vec3(0.0, 0.0, half)
    for end in range(2):
        point = geom_xpos[w, geom] + (2.0 * float(end) - 1.0) * axis
        local = wp.transpose(mat) @ (point - geom_xpos[w, field])
        x, y = (local[0] + size[0]) / dx, (local[1] + size[1]) / dy
        c, r = wp.clamp(int(x), 0, ncol - 2), wp.clamp(int(y), 0, nrow - 2)
        first = hfield_adr[grid] + r * ncol + c
        near = wp.vec2(hfield_data[first], hfield_data[first + 1])
        far = wp.vec2(hfield_data[first + ncol], hfield_data[first + ncol + 1])
        plane = triangle(near[0], near[1], far[0], far[1], x - float(c), y - float(r))
        normal = wp.normalize(wp.vec3(-plane[1] * size[2] / dx, -plane[2] * size[2] / dy, 1.0))
        height = (local[2] - plane[0] * size[2]) * normal[2]
        if height - shape[0] < dist_inout[i]:
            normal = mat @ normal
            side = wp.normalize(wp.cross(normal, wp.where(wp.abs(normal[0]) < 0.5, X, Y)))
            dist_inout[i] = height - shape[0]
            pos_inout[i] = point - 0.5 * (height + shape[0]) * normal
            frame_inout[i] = wp.matrix_from_rows(normal, side, wp.cross(normal, side))
