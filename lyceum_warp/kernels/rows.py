"""Divide a world's rows among ``lanes`` threads: thread ``lane`` gets the indices i with i % lanes == lane."""

import warp as wp


@wp.func
def finite_row(row: wp.array[float], lane: int, lanes: int) -> bool:
    """Return whether every element that this thread reads is finite."""
    for i in range(lane, row.shape[0], lanes):  # noqa: SIM110 (Warp has no all())
        if not wp.isfinite(row[i]):
            return False
    return True


@wp.func
def restored_row(before: wp.array[float], after: wp.array[float], lane: int, lanes: int) -> bool:
    """Replace this thread's elements that are not finite by those of ``before``; return whether all were finite."""
    finite = bool(True)
    for i in range(lane, after.shape[0], lanes):
        if not wp.isfinite(after[i]):
            finite = False
            after[i] = wp.where(wp.isfinite(before[i]), before[i], 0.0)
    return finite


@wp.func
def copy_row(source: wp.array[float], target: wp.array[float], lane: int, lanes: int):
    """Copy the elements that belong to this thread."""
    for i in range(lane, source.shape[0], lanes):
        target[i] = source[i]


@wp.kernel(enable_backward=False)
def mark_changes(
    restarting_in: wp.array[bool],
    before_in: wp.array2d[float],
    after_in: wp.array2d[float],
    physics: bool,
    physics_changed_inout: wp.array[bool],
    changed_inout: wp.array[bool],
    outdated_inout: wp.array[bool],
    lanes: int,
    first: int,
):
    """Mark the worlds that do not restart and whose rows have changed; launched over (nworld, lanes).

    If ``physics`` is set, the worlds are also marked in ``physics_changed``.
    """
    k, lane = wp.tid()
    w = first + k
    if not restarting_in[w]:
        for i in range(lane, after_in.shape[1], lanes):
            if before_in[w, i] != after_in[w, i]:
                if physics:
                    physics_changed_inout[w] = True
                changed_inout[w] = True
                outdated_inout[w] = True
