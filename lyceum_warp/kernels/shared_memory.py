"""Make the kernels that sum and update the memory shared by all worlds."""

import warp as wp

from lyceum_warp.core.done import FAULTS, Done
from lyceum_warp.kernels.step_types import TaskCode

TERMINATED = wp.constant(int(Done.TERMINATED))
ALL_FAULTS = wp.constant(int(FAULTS))

UNIT = wp.constant(2.0**20)
"""Sums over worlds are multiples of 1 / UNIT, so that they do not depend on the order of the worlds."""


def make_shared_memory_kernels(task: TaskCode) -> None:
    tells_failures = "tally" in task.written and "terminated" in task.functions.tally.input_types

    @task.kernel_for("tally")
    def tally_worlds(
        t: task.Transition,
        reason_in: wp.array[int],
        share_out: wp.array2d[float],
        sum_inout: wp.array[wp.int64],
        first: int,
    ):
        """Add each world's tally to the sums, if its transition has no fault; launched over (nworld,)."""
        w = first + wp.tid()
        for i in range(share_out.shape[1]):
            share_out[w, i] = 0.0
        if (reason_in[w] & ALL_FAULTS) == 0:
            s0, s1, p = task.view(t.before, w), task.view(t.after, w), task.params_of(t, w)
            ended, sums = reason_in[w] != 0, task.view_Sums(share_out[w])
            if wp.static(tells_failures):
                task.functions.tally(s0, t.action[w], s1, p, ended, sums, (reason_in[w] & TERMINATED) != 0)
            else:
                task.functions.tally(s0, t.action[w], s1, p, ended, sums)
        for i in range(share_out.shape[1]):
            if share_out[w, i] != 0.0 and wp.isfinite(share_out[w, i]):
                wp.atomic_add(sum_inout, i, wp.int64(wp.round(wp.float64(share_out[w, i]) * wp.float64(UNIT))))

    @task.kernel_for("share")
    def share_memory(
        sum_inout: wp.array[wp.int64],
        sum_row_out: wp.array2d[float],
        params: wp.array[task.Params],
        shared_inout: wp.array2d[float],
        first: int,
    ):
        """Update the shared memory from the sums, and clear the sums; launched over (1,)."""
        for i in range(sum_inout.shape[0]):
            sum_row_out[0, i] = float(wp.float64(sum_inout[i]) / wp.float64(UNIT))
            sum_inout[i] = wp.int64(0)
        task.functions.share(task.view_Shared(shared_inout[0]), task.view_Sums(sum_row_out[0]), params[0])
