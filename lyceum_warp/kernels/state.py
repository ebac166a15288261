"""Copy rows of masked worlds between the arrays of an environment and an engine, and cast them.

The float64 arrays are often views of the engine's states. The kernels write only the masked worlds. A write to any
other world would round that world's state to float32. Most masks are nearly empty and most rows are short, so
``launch_rows`` uses a single thread per world on the CPU, and at most 32 threads per world on a GPU.
"""

import warp as wp


@wp.kernel(enable_backward=False)
def widen(
    mask_in: wp.array[bool], source_in: wp.array2d[float], target_out: wp.array2d[wp.float64], lanes: int, first: int
):
    """Copy the masked rows of a float32 array into a float64 array; launched over (nworld, lanes)."""
    k, lane = wp.tid()
    w = first + k
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = wp.float64(source_in[w, i])


@wp.kernel(enable_backward=False)
def narrow(
    mask_in: wp.array[bool], source_in: wp.array2d[wp.float64], target_out: wp.array2d[float], lanes: int, first: int
):
    """Round the masked rows of a float64 array to float32; launched over (nworld, lanes)."""
    k, lane = wp.tid()
    w = first + k
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = float(source_in[w, i])


@wp.func
def narrow_row(source: wp.array2d[wp.float64], target: wp.array2d[float], w: int):
    for i in range(target.shape[1]):
        target[w, i] = float(source[w, i])


@wp.func
def widen_row(source: wp.array2d[float], target: wp.array2d[wp.float64], w: int):
    for i in range(target.shape[1]):
        target[w, i] = wp.float64(source[w, i])


@wp.kernel(enable_backward=False)
def narrow_four(
    mask_in: wp.array[bool],
    source0_in: wp.array2d[wp.float64],
    target0_out: wp.array2d[float],
    source1_in: wp.array2d[wp.float64],
    target1_out: wp.array2d[float],
    source2_in: wp.array2d[wp.float64],
    target2_out: wp.array2d[float],
    source3_in: wp.array2d[wp.float64],
    target3_out: wp.array2d[float],
    first: int,
):
    """Round the masked rows of four float64 arrays to float32; launched over (nworld,) on the CPU."""
    w = first + wp.tid()
    if mask_in[w]:
        narrow_row(source0_in, target0_out, w)
        narrow_row(source1_in, target1_out, w)
        narrow_row(source2_in, target2_out, w)
        narrow_row(source3_in, target3_out, w)


@wp.kernel(enable_backward=False)
def widen_four(
    mask_in: wp.array[bool],
    source0_in: wp.array2d[float],
    target0_out: wp.array2d[wp.float64],
    source1_in: wp.array2d[float],
    target1_out: wp.array2d[wp.float64],
    source2_in: wp.array2d[float],
    target2_out: wp.array2d[wp.float64],
    source3_in: wp.array2d[float],
    target3_out: wp.array2d[wp.float64],
    first: int,
):
    """Copy the masked rows of four float32 arrays into float64 arrays; launched over (nworld,) on the CPU."""
    w = first + wp.tid()
    if mask_in[w]:
        widen_row(source0_in, target0_out, w)
        widen_row(source1_in, target1_out, w)
        widen_row(source2_in, target2_out, w)
        widen_row(source3_in, target3_out, w)


@wp.kernel(enable_backward=False)
def widen_bool(
    mask_in: wp.array[bool], source_in: wp.array2d[bool], target_out: wp.array2d[wp.float64], lanes: int, first: int
):
    """Write the masked rows of booleans as 0 and 1; launched over (nworld, lanes)."""
    k, lane = wp.tid()
    w = first + k
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = wp.where(source_in[w, i], wp.float64(1.0), wp.float64(0.0))


@wp.kernel(enable_backward=False)
def narrow_bool(
    mask_in: wp.array[bool], source_in: wp.array2d[wp.float64], target_out: wp.array2d[bool], lanes: int, first: int
):
    """Convert masked rows of 0 and 1, which ``widen_bool`` writes, to booleans; launched over (nworld, lanes)."""
    k, lane = wp.tid()
    w = first + k
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = source_in[w, i] != wp.float64(0.0)


@wp.kernel(enable_backward=False)
def copy_rows(
    mask_in: wp.array[bool], source_in: wp.array2d[float], target_out: wp.array2d[float], lanes: int, first: int
):
    """Copy the masked rows of a float32 array; launched over (nworld, lanes)."""
    k, lane = wp.tid()
    w = first + k
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = source_in[w, i]


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
def copy_rows64(
    mask_in: wp.array[bool],
    source_in: wp.array2d[wp.float64],
    target_out: wp.array2d[wp.float64],
    lanes: int,
    first: int,
):
    """Copy the masked rows of a float64 array; launched over (nworld, lanes)."""
    k, lane = wp.tid()
    w = first + k
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = source_in[w, i]


@wp.kernel(enable_backward=False)
def fill_rows64(
    mask_in: wp.array[bool], source_in: wp.array[wp.float64], target_out: wp.array2d[wp.float64], lanes: int, first: int
):
    """Copy one float64 row into all masked rows; launched over (nworld, lanes)."""
    k, lane = wp.tid()
    w = first + k
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = source_in[i]


@wp.kernel(enable_backward=False)
def fill_rows(
    mask_in: wp.array[bool], source_in: wp.array[float], target_out: wp.array2d[float], lanes: int, first: int
):
    """Copy one float32 row into all masked rows; launched over (nworld, lanes)."""
    k, lane = wp.tid()
    w = first + k
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = source_in[i]


@wp.kernel(enable_backward=False)
def pack_counters(
    step_in: wp.array[int],
    key_in: wp.array[wp.uint32],
    episode_in: wp.array[int],
    done_reason_in: wp.array[int],
    state_out: wp.array2d[wp.float64],
):
    """Write step, stream key, episode and done reason into four columns, without rounding; launched over (nworld,)."""
    w = wp.tid()
    state_out[w, 0] = wp.float64(step_in[w])
    state_out[w, 1] = wp.float64(key_in[w])
    state_out[w, 2] = wp.float64(episode_in[w])
    state_out[w, 3] = wp.float64(done_reason_in[w])


@wp.kernel(enable_backward=False)
def unpack_counters(
    mask_in: wp.array[bool],
    state_in: wp.array2d[wp.float64],
    step_out: wp.array[int],
    key_out: wp.array[wp.uint32],
    episode_out: wp.array[int],
    done_reason_out: wp.array[int],
):
    """Read the columns that ``pack_counters`` writes, in the masked worlds; launched over (nworld,)."""
    w = wp.tid()
    if mask_in[w]:
        step_out[w] = int(state_in[w, 0])
        key_out[w] = wp.uint32(state_in[w, 1])
        episode_out[w] = int(state_in[w, 2])
        done_reason_out[w] = int(state_in[w, 3])
