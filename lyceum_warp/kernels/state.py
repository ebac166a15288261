"""Copy rows of masked worlds between the arrays of an environment and an engine, and cast them.

The float64 arrays are often views of the engine's states. The kernels write only the masked worlds. A write to any
other world would round that world's state to float32. Most masks are nearly empty and most rows are short, so
``launch_rows`` uses a single thread per world on the CPU, and at most 32 threads per world on a GPU.
"""

from typing import Any

import warp as wp

from lyceum_warp.kernels.step_types import Counters


def _casts(name: str, source: Any, target: Any) -> wp.Kernel:
    """Make a kernel that copies the masked rows of an array, cast to the target's type; launched over (nworld, lanes).

    A generic kernel cannot replace these kernels, because a CPU graph confuses the overloads of a kernel.
    """

    def cast(
        mask_in: wp.array[bool], source_in: wp.array2d[source], target_out: wp.array2d[target], lanes: int, first: int
    ):
        k, lane = wp.tid()
        w = first + k
        if mask_in[w]:
            for i in range(lane, target_out.shape[1], lanes):
                target_out[w, i] = target_out.dtype(source_in[w, i])

    cast.__qualname__ = name
    return wp.kernel(cast, enable_backward=False)


@wp.func
def cast_row(source: wp.array2d[Any], target: wp.array2d[Any], w: int):
    for i in range(target.shape[1]):
        target[w, i] = target.dtype(source[w, i])


def _casts_four(name: str, source: Any, target: Any) -> wp.Kernel:
    """Make a kernel that copies the masked rows of four arrays, as ``_casts`` does; launched over (nworld,)."""

    def cast_four(
        mask_in: wp.array[bool],
        source0_in: wp.array2d[source],
        target0_out: wp.array2d[target],
        source1_in: wp.array2d[source],
        target1_out: wp.array2d[target],
        source2_in: wp.array2d[source],
        target2_out: wp.array2d[target],
        source3_in: wp.array2d[source],
        target3_out: wp.array2d[target],
        first: int,
    ):
        w = first + wp.tid()
        if mask_in[w]:
            cast_row(source0_in, target0_out, w)
            cast_row(source1_in, target1_out, w)
            cast_row(source2_in, target2_out, w)
            cast_row(source3_in, target3_out, w)

    cast_four.__qualname__ = name
    return wp.kernel(cast_four, enable_backward=False)


copy_rows = _casts("copy_rows", wp.float32, wp.float32)
copy_rows64 = _casts("copy_rows64", wp.float64, wp.float64)
narrow = _casts("narrow", wp.float64, wp.float32)
narrow_bool = _casts("narrow_bool", wp.float64, wp.bool)
narrow_four = _casts_four("narrow_four", wp.float64, wp.float32)
widen = _casts("widen", wp.float32, wp.float64)
widen_bool = _casts("widen_bool", wp.bool, wp.float64)
widen_four = _casts_four("widen_four", wp.float32, wp.float64)


@wp.kernel(enable_backward=False)
def copy_columns(
    mask_in: wp.array[bool], column_in: wp.array[int], source_in: wp.array2d[float], target_out: wp.array2d[float]
):
    """Copy some columns of the masked rows; launched over (nworld, columns)."""
    w, i = wp.tid()
    if mask_in[w]:
        column = column_in[i]
        target_out[w, column] = source_in[w, column]


@wp.kernel(enable_backward=False)
def zero_columns(column_in: wp.array[int], target_out: wp.array2d[float]):
    """Set some columns to zero; launched over (nworld, columns)."""
    w, i = wp.tid()
    target_out[w, column_in[i]] = 0.0


@wp.kernel(enable_backward=False)
def pack_counters(counters_in: Counters, done_reason_in: wp.array[int], state_out: wp.array2d[wp.float64]):
    """Write step, stream key, episode and done reason into four columns, without rounding; launched over (nworld,)."""
    w = wp.tid()
    state_out[w, 0] = wp.float64(counters_in.step[w])
    state_out[w, 1] = wp.float64(counters_in.key[w])
    state_out[w, 2] = wp.float64(counters_in.episode[w])
    state_out[w, 3] = wp.float64(done_reason_in[w])


@wp.kernel(enable_backward=False)
def unpack_counters(
    mask_in: wp.array[bool], state_in: wp.array2d[wp.float64], counters_out: Counters, done_reason_out: wp.array[int]
):
    """Read the columns that ``pack_counters`` writes, in the masked worlds; launched over (nworld,)."""
    w = wp.tid()
    if mask_in[w]:
        counters_out.step[w] = int(state_in[w, 0])
        counters_out.key[w] = wp.uint32(state_in[w, 1])
        counters_out.episode[w] = int(state_in[w, 2])
        done_reason_out[w] = int(state_in[w, 3])
