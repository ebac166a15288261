"""Store the inputs and results of steps in a rollout buffer, at an index on the device."""

import warp as wp

from lyceum_warp.core.done import FAULTS

_FAULTS = wp.constant(int(FAULTS))
_BITS = wp.constant(int(FAULTS).bit_length())


@wp.struct
class RolloutArrays:
    """The arrays of a rollout buffer with one number per world, (steps, nworld)."""

    step: wp.array2d[float]
    reward: wp.array2d[float]
    eval: wp.array2d[float]
    terminated: wp.array2d[bool]
    done: wp.array2d[bool]
    success: wp.array2d[bool]
    episode_return: wp.array2d[float]
    episode_length: wp.array2d[float]


@wp.kernel(enable_backward=False)
def store_steps(index_in: wp.array[int], step_in: wp.array[int], step_out: wp.array2d[float]):
    """Store the step counters before a step; launched over (nworld,)."""
    w = wp.tid()
    step_out[index_in[0], w] = float(step_in[w])


@wp.kernel(enable_backward=False)
def store_outputs(
    index_in: wp.array[int],
    reward_in: wp.array[float],
    eval_in: wp.array[float],
    terminated_in: wp.array[bool],
    done_in: wp.array[bool],
    success_in: wp.array[bool],
    done_reason_in: wp.array[int],
    first_only: bool,
    return_inout: wp.array[float],
    fault_inout: wp.array[int],
    out: RolloutArrays,
):
    """Store the results of a step and the episode's return so far, and count faults; launched over (nworld,).

    If ``first_only`` is set, every return after a world's first episode is NaN.
    """
    w = wp.tid()
    t = index_in[0]
    out.reward[t, w] = reward_in[w]
    out.eval[t, w] = eval_in[w]
    out.terminated[t, w] = terminated_in[w]
    out.done[t, w] = done_in[w]
    out.success[t, w] = success_in[w]
    total = return_inout[w] + reward_in[w]
    out.episode_return[t, w] = total
    out.episode_length[t, w] = out.step[t, w] + 1.0
    if done_in[w]:
        total = wp.where(first_only, wp.nan, 0.0)
    return_inout[w] = total
    fault = done_reason_in[w] & _FAULTS
    for bit in range(_BITS):
        fault_inout[w] = fault_inout[w] + ((fault >> bit) & 1)


@wp.kernel(enable_backward=False)
def store_rows(index_in: wp.array[int], rows_in: wp.array2d[float], rows_out: wp.array3d[float]):
    """Store one row per world; launched over (nworld, size of a row)."""
    w, i = wp.tid()
    rows_out[index_in[0], w, i] = rows_in[w, i]


@wp.kernel(enable_backward=False)
def advance_index(index_inout: wp.array[int]):
    """Increase the index by one; launched over (1,)."""
    index_inout[0] = index_inout[0] + 1
