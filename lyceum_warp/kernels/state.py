"""Casts and masked copies between the arrays of an environment and of an engine.

All arrays are (nworld, n) and every kernel is launched over (nworld, n). The float64 side is often a strided
alias of an engine's own rows, where an unmasked write would round the other worlds.
"""

import warp as wp


@wp.kernel(enable_backward=False)
def widen(mask_in: wp.array[bool], source_in: wp.array2d[float], target_out: wp.array2d[wp.float64]):
    w, i = wp.tid()
    if mask_in[w]:
        target_out[w, i] = wp.float64(source_in[w, i])


@wp.kernel(enable_backward=False)
def narrow(mask_in: wp.array[bool], source_in: wp.array2d[wp.float64], target_out: wp.array2d[float]):
    w, i = wp.tid()
    if mask_in[w]:
        target_out[w, i] = float(source_in[w, i])


@wp.kernel(enable_backward=False)
def copy_rows(mask_in: wp.array[bool], source_in: wp.array2d[float], target_out: wp.array2d[float]):
    w, i = wp.tid()
    if mask_in[w]:
        target_out[w, i] = source_in[w, i]


@wp.kernel(enable_backward=False)
def copy_rows64(mask_in: wp.array[bool], source_in: wp.array2d[wp.float64], target_out: wp.array2d[wp.float64]):
    w, i = wp.tid()
    if mask_in[w]:
        target_out[w, i] = source_in[w, i]


@wp.kernel(enable_backward=False)
def fill_rows64(mask_in: wp.array[bool], row_in: wp.array[wp.float64], target_out: wp.array2d[wp.float64]):
    w, i = wp.tid()
    if mask_in[w]:
        target_out[w, i] = row_in[i]


@wp.kernel(enable_backward=False)
def pack_counters(
    step_in: wp.array[int],
    key_in: wp.array[wp.uint32],
    episode_in: wp.array[int],
    state_out: wp.array2d[wp.float64],
):
    """Step, stream key and episode into three columns; float64 holds every 32-bit integer exactly."""
    w = wp.tid()
    state_out[w, 0] = wp.float64(step_in[w])
    state_out[w, 1] = wp.float64(key_in[w])
    state_out[w, 2] = wp.float64(episode_in[w])


@wp.kernel(enable_backward=False)
def unpack_counters(
    mask_in: wp.array[bool],
    state_in: wp.array2d[wp.float64],
    step_out: wp.array[int],
    key_out: wp.array[wp.uint32],
    episode_out: wp.array[int],
):
    w = wp.tid()
    if mask_in[w]:
        step_out[w] = int(state_in[w, 0])
        key_out[w] = wp.uint32(state_in[w, 1])
        episode_out[w] = int(state_in[w, 2])
