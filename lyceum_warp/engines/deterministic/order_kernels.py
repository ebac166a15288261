"""Define kernels that sort contacts and constraint rows into an order that does not depend on thread timing.

MuJoCo Warp assigns indices to contacts and constraint rows by atomic counters, so their order varies on a GPU. Sums
over contacts or rows are then rounded differently in each run, and runs diverge. These kernels sort contacts by (world,
geoms, index within the pair), and each world's rows by (type, object, index within the constraint).
"""

import warp as wp

_EQUALITY, _FIRST_CONTACT = wp.constant(0), wp.constant(5)  # of mjtConstraint
_NO_CONTACT = wp.constant(wp.int64(2**63 - 1))


@wp.struct
class Contacts:
    """The fields of contacts as 32-bit words, (naconmax, words)."""

    dist: wp.array2d[int]
    pos: wp.array2d[int]
    frame: wp.array2d[int]
    includemargin: wp.array2d[int]
    friction: wp.array2d[int]
    solref: wp.array2d[int]
    solreffriction: wp.array2d[int]
    solimp: wp.array2d[int]
    dim: wp.array2d[int]
    geom: wp.array2d[int]
    flex: wp.array2d[int]
    elem: wp.array2d[int]
    vert: wp.array2d[int]
    efc_address: wp.array2d[int]
    worldid: wp.array2d[int]
    type: wp.array2d[int]
    geomcollisionid: wp.array2d[int]
    adhesion: wp.array2d[int]
    surfacevel: wp.array2d[int]


@wp.kernel(enable_backward=False)
def contact_keys(
    ncontact_in: wp.array[int], contacts: Contacts, nmax: int, key_out: wp.array[wp.int64], place_out: wp.array[int]
):
    """Compute the contacts' keys for sorting; launched over (naconmax,).

    A key has 24 bits for the world, 14 for each geom, and 11 for the index within the pair. Unused contact slots come
    last in the order.
    """
    c = wp.tid()
    place_out[c] = c
    key = _NO_CONTACT
    if c < wp.min(ncontact_in[0], nmax):
        key = wp.int64(contacts.worldid[c, 0])
        key = key * wp.int64(16384) + wp.int64((contacts.geom[c, 0] + 1) & 16383)
        key = key * wp.int64(16384) + wp.int64((contacts.geom[c, 1] + 1) & 16383)
        key = key * wp.int64(2048) + wp.int64(contacts.geomcollisionid[c, 0] & 2047)
    key_out[c] = key


@wp.func
def _move(source: wp.array2d[int], i: int, target: wp.array2d[int], j: int):
    if j < target.shape[0]:
        for k in range(target.shape[1]):
            target[j, k] = source[i, k]


@wp.kernel(enable_backward=False)
def gather_contacts(
    ncontact_in: wp.array[int], place_in: wp.array[int], sort: bool, nmax: int, source: Contacts, target: Contacts
):
    """Copy contacts, in sorted order if ``sort`` is true; launched over (naconmax,)."""
    c = wp.tid()
    if c >= wp.min(ncontact_in[0], nmax):
        return
    i = c
    if sort:
        i = place_in[c]
    _move(source.dist, i, target.dist, c)
    _move(source.pos, i, target.pos, c)
    _move(source.frame, i, target.frame, c)
    _move(source.includemargin, i, target.includemargin, c)
    _move(source.friction, i, target.friction, c)
    _move(source.solref, i, target.solref, c)
    _move(source.solreffriction, i, target.solreffriction, c)
    _move(source.solimp, i, target.solimp, c)
    _move(source.dim, i, target.dim, c)
    _move(source.geom, i, target.geom, c)
    _move(source.flex, i, target.flex, c)
    _move(source.elem, i, target.elem, c)
    _move(source.vert, i, target.vert, c)
    _move(source.efc_address, i, target.efc_address, c)
    _move(source.worldid, i, target.worldid, c)
    _move(source.type, i, target.type, c)
    _move(source.geomcollisionid, i, target.geomcollisionid, c)
    _move(source.adhesion, i, target.adhesion, c)
    _move(source.surfacevel, i, target.surfacevel, c)


@wp.struct
class Rows:
    """The fields of constraint rows, (nworld, njmax or more). ``J`` has a third axis, the columns of the Jacobian."""

    type: wp.array2d[int]
    id: wp.array2d[int]
    pos: wp.array2d[float]
    margin: wp.array2d[float]
    D: wp.array2d[float]
    vel: wp.array2d[float]
    aref: wp.array2d[float]
    frictionloss: wp.array2d[float]
    J_rownnz: wp.array2d[int]
    J_rowadr: wp.array2d[int]
    J: wp.array3d[float]
    jtdaj_adr: wp.array2d[int]
    jtdaj_nrow: wp.array2d[int]
    jtdaj_nblock: wp.array[int]


@wp.func
def _kind(rows: Rows, w: int, r: int):
    # all types of contact rows have the same key, so that the rows of a contact stay together
    return wp.min(rows.type[w, r], _FIRST_CONTACT)


@wp.func
def _object(rows: Rows, eq_type: wp.array[int], w: int, r: int) -> int:
    i = rows.id[w, r]
    if rows.type[w, r] == _EQUALITY:
        # MuJoCo Warp requires the order: connects, welds, other equalities
        i = i + eq_type[i] * eq_type.shape[0]
    return i


@wp.kernel(enable_backward=False)
def rank_rows(nrow_in: wp.array[int], eq_type_in: wp.array[int], rows: Rows, rank_out: wp.array2d[int]):
    """Find the new index of each row; launched over (nworld, njmax)."""
    w, r = wp.tid()
    n = int(wp.min(nrow_in[w], rank_out.shape[1]))
    if r >= n:
        return
    kind = _kind(rows, w, r)
    number = _object(rows, eq_type_in, w, r)
    rank = int(0)
    for s in range(n):
        other = _kind(rows, w, s)
        if other < kind:
            rank += 1
        elif other == kind:
            i = _object(rows, eq_type_in, w, s)
            if i < number or (i == number and s < r):
                rank += 1
    rank_out[w, r] = rank


@wp.kernel(enable_backward=False)
def move_rows(
    nrow_in: wp.array[int],
    rank_in: wp.array2d[int],
    sort: bool,
    sparse: bool,
    lanes: int,
    source: Rows,
    target: Rows,
):
    """Copy rows, in sorted order if ``sort`` is true.

    Launched over (nworld, njmax, lanes).
    """
    w, r, lane = wp.tid()
    if r >= int(wp.min(nrow_in[w], rank_in.shape[1])):
        return
    to = r
    if sort:
        to = rank_in[w, r]
    if not sparse:
        for k in range(lane, source.J.shape[2], lanes):
            target.J[w, to, k] = source.J[w, r, k]
    if lane > 0:
        return
    target.type[w, to] = source.type[w, r]
    target.id[w, to] = source.id[w, r]
    target.pos[w, to] = source.pos[w, r]
    target.margin[w, to] = source.margin[w, r]
    target.D[w, to] = source.D[w, r]
    target.vel[w, to] = source.vel[w, r]
    target.aref[w, to] = source.aref[w, r]
    target.frictionloss[w, to] = source.frictionloss[w, r]
    if sparse:  # this kernel does not move the entries of a sparse Jacobian
        target.J_rownnz[w, to] = source.J_rownnz[w, r]
        target.J_rowadr[w, to] = source.J_rowadr[w, r]
        if source.jtdaj_adr.shape[1] > 0 and r < source.jtdaj_nblock[w]:
            first = source.jtdaj_adr[w, r]
            to = r
            if sort:
                first = rank_in[w, first]
                to = int(0)
                for b in range(source.jtdaj_nblock[w]):
                    if rank_in[w, source.jtdaj_adr[w, b]] < first:
                        to += 1
            target.jtdaj_adr[w, to] = first
            target.jtdaj_nrow[w, to] = source.jtdaj_nrow[w, r]


@wp.kernel(enable_backward=False)
def move_addresses(ncontact_in: wp.array[int], rank_in: wp.array2d[int], nmax: int, contacts: Contacts):
    """Update the indices of constraint rows in each contact; launched over (naconmax, rows per contact)."""
    c, i = wp.tid()
    if c < wp.min(ncontact_in[0], nmax):
        row = contacts.efc_address[c, i]
        if row >= 0:
            contacts.efc_address[c, i] = rank_in[contacts.worldid[c, 0], row]
