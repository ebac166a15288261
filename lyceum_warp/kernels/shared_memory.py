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
    def tally_worlds(t: task.Transition, reason_in: wp.array[int], share_out: wp.array2d[float], first: int):
        """Tally each world whose transition has no fault, into rows of zeros; launched over (nworld,)."""
        w = first + wp.tid()
        if (reason_in[w] & ALL_FAULTS) == 0:
            s0, s1, p = task.view(t.before, w), task.view(t.after, w), task.params_of(t, w)
            ended, sums = reason_in[w] != 0, task.view_Sums(share_out[w])
            if wp.static(tells_failures):
                task.functions.tally(s0, t.action[w], s1, p, ended, sums, (reason_in[w] & TERMINATED) != 0)
            else:
                task.functions.tally(s0, t.action[w], s1, p, ended, sums)

    @task.kernel_for("tally")
    def add_tallies(share_inout: wp.array2d[float], sum_inout: wp.array[wp.int64], lanes: int, first: int):
        """Add the worlds' tallies to the sums, and clear the tallies; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        for i in range(lane, share_inout.shape[1], lanes):
            share = share_inout[w, i]
            if share != 0.0:
                share_inout[w, i] = 0.0
                if wp.isfinite(share):
                    wp.atomic_add(sum_inout, i, wp.int64(wp.round(wp.float64(share) * wp.float64(UNIT))))

    @task.kernel_for("share")
    def share_memory(
        sum_inout: wp.array[wp.int64],
        sum_row_inout: wp.array2d[float],
        params: wp.array[task.Params],
        shared_inout: wp.array2d[float],
        first: int,
    ):
        """Update the shared memory from the sums, and clear the sums; launched over (1,)."""
        for i in range(sum_inout.shape[0]):
            sum_row_inout[0, i] = float(wp.float64(sum_inout[i]) / wp.float64(UNIT))
            sum_inout[i] = wp.int64(0)
        task.functions.share(task.view_Shared(shared_inout[0]), task.view_Sums(sum_row_inout[0]), params[0])
        for i in range(sum_inout.shape[0]):
            sum_row_inout[0, i] = 0.0
