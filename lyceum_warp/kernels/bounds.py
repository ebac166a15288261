"""Checks of indices, for the copies of a task's functions that ``check_task`` runs.

``report`` is (places, 3): for each place in the source the number of times that an index was out of range, the first
such index, and the size that it was compared with. The functions are not inlined: that would take the compiler long.
"""

from typing import Any

import warp as wp

MOST_ROUNDS = wp.constant(1_000_000)
"""Rounds after which a ``while`` loop is reported as endless."""


@wp.func(inline=False)
def note(report: wp.array2d[int], place: int, index: int, size: int):
    """Keep the first index that is out of range at a place."""
    if wp.atomic_add(report, place, 0, 1) == 0:
        report[place, 1] = index
        report[place, 2] = size


@wp.func(inline=False)
def at(report: wp.array2d[int], place: int, index: Any, size: int) -> int:
    """An index within a size; 0 for one that is out of range, also a negative one."""
    i = int(index)
    if i < 0 or i >= size:
        note(report, place, i, size)
        return 0
    return i


@wp.func(inline=False)
def from_end(report: wp.array2d[int], place: int, index: int, size: int) -> int:
    """The same for a negative constant, which counts from the end as in Python."""
    if index < -size:
        note(report, place, index, size)
        return 0
    return index + size


@wp.func
def element(report: wp.array2d[int], place: int, values: Any, index: Any):
    """An element of the result of a call, which is evaluated once."""
    return values[at(report, place, index, len(values))]


@wp.func
def is_endless(report: wp.array2d[int], place: int, rounds: int) -> bool:
    """Whether a loop has run too often, here or before."""
    if rounds > MOST_ROUNDS:
        note(report, place, rounds, 0)
    return report[place, 0] > 0
