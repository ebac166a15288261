"""Check array indices while ``check_task`` runs instrumented copies of a task's functions.

``report`` is (places, 3). Each row describes one place in the source at which an array is indexed. A row holds the
number of bad indices, the first bad index, and the size of the array. Functions are not inlined, because inlining would
increase compile times.
"""

from typing import Any

import warp as wp


@wp.func(inline=False)
def note(report: wp.array2d[int], place: int, index: int, size: int):
    """Count a bad index in row ``place`` of the report; store the index and the size if it is the first one."""
    if wp.atomic_add(report, place, 0, 1) == 0:
        report[place, 1] = index
        report[place, 2] = size


@wp.func(inline=False)
def at(report: wp.array2d[int], place: int, index: Any, size: int) -> int:
    """Return a valid index unchanged; if the index is not from 0 to size - 1, report it and return 0."""
    i = int(index)
    if i < 0 or i >= size:
        note(report, place, i, size)
        return 0
    return i


@wp.func(inline=False)
def from_end(report: wp.array2d[int], place: int, index: int, size: int) -> int:
    """Convert a negative index, which counts from the end of the array as in Python, and report it if it is too low."""
    if index < -size:
        note(report, place, index, size)
        return 0
    return index + size


@wp.func
def element(report: wp.array2d[int], place: int, values: Any, index: Any):
    """Return one element of the result of a function call.

    The instrumented source replaces ``f(x)[i]`` by ``element(report, place, f(x), i)``, which calls ``f`` only once.
    """
    return values[at(report, place, index, len(values))]
