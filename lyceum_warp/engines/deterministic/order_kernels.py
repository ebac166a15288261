"""Define kernels that sort contacts and constraint rows into an order that does not depend on thread timing.

MuJoCo Warp assigns indices to contacts and constraint rows by atomic counters, so their order varies on a GPU. Sums
over contacts or rows are then rounded differently in each run, and runs diverge. These kernels sort contacts by (world,
geoms, index within the pair), and each world's rows by (type, object, index within the constraint).
"""

import warp as wp

_EQUALITY, _FIRST_CONTACT = wp.constant(0), wp.constant(5)  # of mjtConstraint
_NO_CONTACT = wp.constant(wp.int64(2**63 - 1))


@wp.struct
class Copy:
    """A field of contacts or constraint rows as 32-bit words, (contacts, words) or (nworld, rows), and its copy."""

    source: wp.array2d[int]
    target: wp.array2d[int]


@wp.kernel(enable_backward=False)
def contact_keys(
    ncontact_in: wp.array[int],
    world_in: wp.array[int],
    geom_in: wp.array[wp.vec2i],
    index_in: wp.array[int],
    nmax: int,
    key_out: wp.array[wp.int64],
    place_out: wp.array[int],
):
    """Compute the contacts' keys for sorting; launched over (naconmax,).

    A key has 24 bits for the world, 14 for each geom, and 11 for the index within the pair. Unused contact slots come
    last in the order.
    """
    c = wp.tid()
    place_out[c] = c
    key = _NO_CONTACT
    if c < wp.min(ncontact_in[0], nmax):
        key = wp.int64(world_in[c])
        key = key * wp.int64(16384) + wp.int64((geom_in[c][0] + 1) & 16383)
        key = key * wp.int64(16384) + wp.int64((geom_in[c][1] + 1) & 16383)
        key = key * wp.int64(2048) + wp.int64(index_in[c] & 2047)
    key_out[c] = key


@wp.kernel(enable_backward=False)
def gather_contacts(ncontact_in: wp.array[int], place_in: wp.array[int], sort: bool, fields: wp.array[Copy]):
    """Copy contacts, in sorted order if ``sort`` is true; launched over (number of fields, naconmax)."""
    f, c = wp.tid()
    field = fields[f]
    if c >= wp.min(ncontact_in[0], field.target.shape[0]):
        return
    i = c
    if sort:
        i = place_in[c]
    for k in range(field.target.shape[1]):
        field.target[c, k] = field.source[i, k]


@wp.func
def _kind(type_in: wp.array2d[int], w: int, r: int):
    # all types of contact rows have the same key, so that the rows of a contact stay together
    return wp.min(type_in[w, r], _FIRST_CONTACT)


@wp.func
def _object(type_in: wp.array2d[int], id_in: wp.array2d[int], eq_type_in: wp.array[int], w: int, r: int) -> int:
    i = id_in[w, r]
    if type_in[w, r] == _EQUALITY:
        # MuJoCo Warp requires the order: connects, welds, other equalities
        i = i + eq_type_in[i] * eq_type_in.shape[0]
    return i


@wp.kernel(enable_backward=False)
def rank_rows(
    nrow_in: wp.array[int],
    eq_type_in: wp.array[int],
    type_in: wp.array2d[int],
    id_in: wp.array2d[int],
    rank_out: wp.array2d[int],
):
    """Find the new index of each row; launched over (nworld, njmax)."""
    w, r = wp.tid()
    n = int(wp.min(nrow_in[w], rank_out.shape[1]))
    if r >= n:
        return
    kind = _kind(type_in, w, r)
    number = _object(type_in, id_in, eq_type_in, w, r)
    rank = int(0)
    for s in range(n):
        other = _kind(type_in, w, s)
        if other < kind:
            rank += 1
        elif other == kind:
            i = _object(type_in, id_in, eq_type_in, w, s)
            if i < number or (i == number and s < r):
                rank += 1
    rank_out[w, r] = rank


@wp.kernel(enable_backward=False)
def move_rows(
    nrow_in: wp.array[int],
    rank_in: wp.array2d[int],
    sort: bool,
    lanes: int,
    fields: wp.array[Copy],
    jacobian_in: wp.array3d[float],
    jacobian_out: wp.array3d[float],
):
    """Copy rows and a dense Jacobian, in sorted order if ``sort`` is true; launched over (nworld, njmax, lanes)."""
    w, r, lane = wp.tid()
    if r >= int(wp.min(nrow_in[w], rank_in.shape[1])):
        return
    to = r
    if sort:
        to = rank_in[w, r]
    for f in range(lane, fields.shape[0], lanes):
        field = fields[f]
        field.target[w, to] = field.source[w, r]
    for k in range(lane, jacobian_in.shape[2], lanes):
        jacobian_out[w, to, k] = jacobian_in[w, r, k]


@wp.kernel(enable_backward=False)
def move_blocks(
    nblock_in: wp.array[int],
    rank_in: wp.array2d[int],
    sort: bool,
    address_in: wp.array2d[int],
    size_in: wp.array2d[int],
    address_out: wp.array2d[int],
    size_out: wp.array2d[int],
):
    """Copy the blocks of a sparse Jacobian, in sorted order if ``sort`` is true; launched over (nworld, blocks)."""
    w, b = wp.tid()
    if b >= nblock_in[w]:
        return
    first = address_in[w, b]
    to = b
    if sort:
        first = rank_in[w, first]
        to = int(0)
        for other in range(nblock_in[w]):
            if rank_in[w, address_in[w, other]] < first:
                to += 1
    address_out[w, to] = first
    size_out[w, to] = size_in[w, b]


@wp.kernel(enable_backward=False)
def move_addresses(
    ncontact_in: wp.array[int], rank_in: wp.array2d[int], world_in: wp.array[int], address_inout: wp.array2d[int]
):
    """Update the indices of constraint rows in each contact; launched over (naconmax, rows per contact)."""
    c, i = wp.tid()
    if c < wp.min(ncontact_in[0], address_inout.shape[0]):
        row = address_inout[c, i]
        if row >= 0:
            address_inout[c, i] = rank_in[world_in[c], row]
