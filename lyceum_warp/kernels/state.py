"""Casts and masked copies between the arrays of an environment and of an engine.

The float64 side is often a strided alias of an engine's own rows, where an unmasked write would round the other
worlds. Most masks are nearly empty, and most rows short: ``launch_rows`` gives each world as many threads as pay
off on the device, one on the CPU and a warp on a GPU.
"""

import warp as wp


@wp.kernel(enable_backward=False)
def widen(mask_in: wp.array[bool], source_in: wp.array2d[float], target_out: wp.array2d[wp.float64], lanes: int):
    w, lane = wp.tid()
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = wp.float64(source_in[w, i])


@wp.kernel(enable_backward=False)
def narrow(mask_in: wp.array[bool], source_in: wp.array2d[wp.float64], target_out: wp.array2d[float], lanes: int):
    w, lane = wp.tid()
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = float(source_in[w, i])


@wp.kernel(enable_backward=False)
def copy_rows(mask_in: wp.array[bool], source_in: wp.array2d[float], target_out: wp.array2d[float], lanes: int):
    w, lane = wp.tid()
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = source_in[w, i]


@wp.kernel(enable_backward=False)
def copy_rows64(
    mask_in: wp.array[bool], source_in: wp.array2d[wp.float64], target_out: wp.array2d[wp.float64], lanes: int
):
    w, lane = wp.tid()
    if mask_in[w]:
        for i in range(lane, target_out.shape[1], lanes):
            target_out[w, i] = source_in[w, i]


@wp.kernel(enable_backward=False)
def fill_rows64(
    mask_in: wp.array[bool], source_in: wp.array[wp.float64], target_out: wp.array2d[wp.float64], lanes: int
):
    w, lane = wp.tid()
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
    """Step, stream key, episode and done reason into four columns; float64 holds every 32-bit integer exactly."""
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
    w = wp.tid()
    if mask_in[w]:
        step_out[w] = int(state_in[w, 0])
        key_out[w] = wp.uint32(state_in[w, 1])
        episode_out[w] = int(state_in[w, 2])
        done_reason_out[w] = int(state_in[w, 3])


# Masked worlds taken out a few at a time: each has a rank, and a group holds those from rank `first` on.


@wp.kernel(enable_backward=False)
def rank_worlds(mask_in: wp.array[bool], rank_out: wp.array[int], count_inout: wp.array[int]):
    """Number the masked worlds, in no particular order, from a count of 0 on."""
    w = wp.tid()
    if mask_in[w]:
        rank_out[w] = wp.atomic_add(count_inout, 0, 1)


@wp.kernel(enable_backward=False)
def next_group(count_in: wp.array[int], step: int, first_inout: wp.array[int], left_out: wp.array[int]):
    """Go on by ``step`` worlds, and say how many are left from there on."""
    first = first_inout[0] + step
    first_inout[0] = first
    left_out[0] = wp.max(0, count_in[0] - first)


@wp.kernel(enable_backward=False)
def choose_group(mask_in: wp.array[bool], rank_in: wp.array[int], first_in: wp.array[int], world_out: wp.array[int]):
    """Which world is in each place of a group."""
    w = wp.tid()
    if mask_in[w]:
        place = rank_in[w] - first_in[0]
        if place >= 0 and place < world_out.shape[0]:
            world_out[place] = w


@wp.kernel(enable_backward=False)
def take_rows(
    world_in: wp.array[int], left_in: wp.array[int], source_in: wp.array2d[float], target_out: wp.array2d[float]
):
    """Rows of the worlds in a group."""
    place, i = wp.tid()
    if place < left_in[0]:
        target_out[place, i] = source_in[world_in[place], i]


@wp.kernel(enable_backward=False)
def return_rows(
    world_in: wp.array[int], left_in: wp.array[int], source_in: wp.array2d[float], target_out: wp.array2d[float]
):
    """Rows of a group, to the worlds that they belong to."""
    place, i = wp.tid()
    if place < left_in[0]:
        target_out[world_in[place], i] = source_in[place, i]


@wp.kernel(enable_backward=False)
def return_bits(world_in: wp.array[int], left_in: wp.array[int], source_in: wp.array[int], target_inout: wp.array[int]):
    """Bits of a group, added to those of the worlds that they belong to."""
    place = wp.tid()
    if place < left_in[0]:
        world = world_in[place]
        target_inout[world] = target_inout[world] | source_in[place]
