"""Find each world's faults, as bits of ``Done``."""

import warp as wp

from lyceum_warp.core.done import Done

MAX_MAGNITUDE = wp.constant(1.0e10)
NAN = wp.constant(int(Done.NAN))
CONTACT = wp.constant(int(Done.CONTACT_OVERFLOW))
CONSTRAINT = wp.constant(int(Done.CONSTRAINT_OVERFLOW))
WARNING = wp.constant(int(Done.ENGINE_WARNING))


@wp.func
def is_out_of_range(x: float) -> bool:
    # every comparison with NaN is false, so this form counts NaN as out of range
    return not (wp.abs(x) < MAX_MAGNITUDE)


@wp.func
def row_in_range(row: wp.array[float], lane: int, lanes: int) -> bool:
    """Return whether every element that this thread reads is smaller than 1e10 in magnitude."""
    valid = bool(True)
    for i in range(lane, row.shape[0], lanes):  # without an early return, a GPU loads several elements at a time
        if is_out_of_range(row[i]):
            valid = False
    return valid


@wp.func
def count_faults(fault: int, count_inout: wp.array[int]):
    """Increment the counters of the fault bits that are set."""
    for bit in range(count_inout.shape[0]):
        if ((fault >> bit) & 1) != 0:
            count_inout[bit] = count_inout[bit] + 1


@wp.kernel(enable_backward=False)
def faults_of_rows(
    mask_in: wp.array[bool],
    state_in: wp.array2d[wp.float64],
    nphysics: int,
    warning_inout: wp.array3d[int],
    fault_out: wp.array[int],
    first: int,
):
    """Check the masked worlds of the C engine for faults; launched over (nworld,).

    The first ``nphysics`` columns of ``state`` are time, qpos, qvel and act. ``warning`` holds counters, (nworld, kind,
    2), which this kernel clears. The kinds are those of mjtWarning: 0 inertia, 1 contacts full, 2 constraints full, 3
    to 5 bad qpos, qvel, qacc, 6 bad control. A bad control counts as a bad state, as on the Warp engine.
    """
    w = first + wp.tid()
    if not mask_in[w]:
        return
    fault = int(0)
    for i in range(nphysics):
        if not (wp.abs(state_in[w, i]) < wp.float64(MAX_MAGNITUDE)):
            fault = fault | NAN
    for kind in range(warning_inout.shape[1]):
        if warning_inout[w, kind, 1] > 0:
            warning_inout[w, kind, 1] = 0
            if kind == 1:
                fault = fault | CONTACT
            elif kind == 2:
                fault = fault | CONSTRAINT
            elif kind >= 3 and kind <= 6:
                fault = fault | NAN
            else:
                fault = fault | WARNING
    if (fault & NAN) != 0:  # after a bad state, other warnings are side effects, for example about the inertia matrix
        fault = fault & ~WARNING
    fault_out[w] = fault


@wp.kernel(enable_backward=False)
def pool_overflow(
    mask_in: wp.array[bool],
    npair_in: wp.array[int],
    ncontact_in: wp.array[int],
    nmax: int,
    bits: int,
    overflow_inout: wp.array[int],
):
    """Set the overflow bits if the pool of pairs or contacts is full, as ``mujoco_warp.step`` does.

    Launched over (nworld,).
    """
    w = wp.tid()
    if mask_in[w] and (npair_in[0] > nmax or ncontact_in[0] > nmax):
        overflow_inout[w] = overflow_inout[w] | bits


@wp.kernel(enable_backward=False)
def faults_of_fields(
    mask_in: wp.array[bool],
    qpos_in: wp.array2d[float],
    qvel_inout: wp.array2d[float],
    act_in: wp.array2d[float],
    overflow_in: wp.array[int],
    contact_bits: int,
    constraint_bits: int,
    ignored_bits: int,
    jacobian_out: wp.array3d[float],
    fault_out: wp.array[int],
):
    """Find faults of the Warp engine in the masked worlds, from states and overflow bits; launched over (nworld,).

    Contacts of a geom whose position is NaN leave NaN in rows of the Jacobian. The solver multiplies unused rows by
    zero, and NaN times zero is NaN. So the Jacobian of a world with NaN is cleared.

    A step turns a quaternion with NaN into a valid one. So a velocity becomes NaN, too, and stays so in the next steps.
    """
    w = wp.tid()
    if not mask_in[w]:
        return
    fault = int(0)
    placed = row_in_range(qpos_in[w], 0, 1)
    if not placed:
        qvel_inout[w, 0] = wp.nan
    if not (placed and row_in_range(qvel_inout[w], 0, 1) and row_in_range(act_in[w], 0, 1)):
        fault = NAN
        for i in range(jacobian_out.shape[1]):
            for j in range(jacobian_out.shape[2]):
                jacobian_out[w, i, j] = 0.0
    overflow = overflow_in[w] & ~ignored_bits
    if (overflow & contact_bits) != 0:
        fault = fault | CONTACT
    if (overflow & constraint_bits) != 0:
        fault = fault | CONSTRAINT
    if (overflow & ~(contact_bits | constraint_bits)) != 0:
        fault = fault | WARNING
    fault_out[w] = fault
