"""Open-loop rollouts: copy states to worlds, map actions to controls, judge all steps at once, merge faults.

Row t * nworld + w of a judged rollout is world w after t steps. ``before`` and ``after`` are views of the same arrays,
but ``after`` starts at row nworld, and thus holds the next states.
"""

import warp as wp

from lyceum_warp.core.done import Done
from lyceum_warp.kernels.random import stream
from lyceum_warp.kernels.rows import copy_row
from lyceum_warp.kernels.step_types import TaskCode

ACTION = wp.constant(int(Done.ACTION))


@wp.func
def plant_of(row: int, rows: int, plants: int) -> int:
    """Return the plant to which a row belongs.

    A row is a sample or a world, and the rows of a plant are consecutive.
    """
    if plants == 1:  # the division would double the time of a small kernel on the CPU
        return 0
    return row // (rows // plants)


@wp.func
def first_row(plant: int, rows: int, plants: int) -> int:
    """Return the index of a plant's first row."""
    if plant == 0:
        return 0
    return plant * (rows // plants)


@wp.kernel(enable_backward=False)
def broadcast(state_in: wp.array2d[wp.float64], state_out: wp.array2d[wp.float64]):
    """Copy each state to an equal number of consecutive worlds; launched over (nworld, state_size)."""
    w, i = wp.tid()
    state_out[w, i] = state_in[plant_of(w, state_out.shape[0], state_in.shape[0]), i]


@wp.kernel(enable_backward=False)
def overwrite_rows(rows_in: wp.array2d[wp.float64], choice: int, first: int, state_inout: wp.array2d[wp.float64]):
    """Copy a row into each state, starting at column ``first``; launched over (nworld, size).

    State w gets row w, or the row whose number is in column ``choice`` of the state, if ``choice`` is not negative. The
    rows repeat.
    """
    w, i = wp.tid()
    row = w
    if choice >= 0:
        row = int(state_inout[w, choice])
    state_inout[w, first + i] = rows_in[row % rows_in.shape[0], i]


@wp.func
def control_of(action: float, i: int, range_in: wp.array2d[float], scale_in: wp.array2d[float]) -> float:
    """Map element ``i`` of an action to its control, clipped to the control's range, for tasks without ``control``."""
    return wp.clamp(action * scale_in[i, 0] + scale_in[i, 1], range_in[i, 0], range_in[i, 1])


@wp.kernel(enable_backward=False)
def controls(
    action_inout: wp.array3d[float],
    range_in: wp.array2d[float],
    scale_in: wp.array2d[float],
    fault_out: wp.array[int],
    ctrl_out: wp.array3d[float],
):
    """Map actions to controls, clipped to their ranges; launched over (steps, nworld).

    An action that is not finite becomes zero, and causes a fault in its world.
    """
    t, w = wp.tid()
    fault = int(0)
    for i in range(action_inout.shape[2]):
        if not wp.isfinite(action_inout[t, w, i]):
            fault = ACTION
    if fault != 0:
        fault_out[w] = fault
        for i in range(action_inout.shape[2]):
            action_inout[t, w, i] = 0.0
    for i in range(ctrl_out.shape[2]):
        ctrl_out[t, w, i] = control_of(action_inout[t, w, i], i, range_in, scale_in)


@wp.kernel(enable_backward=False)
def repeat_columns(columns_in: wp.array2d[wp.float64], rows_out: wp.array3d[float]):
    """Copy columns of states into a buffer, once for each step; launched over (steps, nworld, columns)."""
    t, w, i = wp.tid()
    rows_out[t, w, i] = float(columns_in[w, i])


@wp.kernel(enable_backward=False)
def add_to(number: int, count_inout: wp.array[int]):
    """Add a number to counters; launched over the number of counters."""
    w = wp.tid()
    count_inout[w] = count_inout[w] + number


@wp.kernel(enable_backward=False)
def merge_faults(fault_in: wp.array[int], fault_inout: wp.array[int]):
    """Add the bits of one array of faults to another; launched over (nworld,)."""
    w = wp.tid()
    fault_inout[w] = fault_inout[w] | fault_in[w]


def make_rollout_kernels(task: TaskCode) -> None:
    @task.kernel()
    def judge_rows(t: task.Transition, reward_out: wp.array[float], terminated_out: wp.array[bool], first: int):
        """Compute reward and termination of a rollout's transitions; launched over (steps * nworld,)."""
        row = first + wp.tid()
        s0, s1, p = task.view(t.before, row), task.view(t.after, row), task.params_of(t, row)
        if wp.static(hasattr(task.terms, "reward")):
            weights = t.weights[row % t.weights.shape[0]]
            reward_out[row] = task.terms.reward(s0, t.action[row], s1, p, weights)
        else:
            reward_out[row] = task.functions.reward(s0, t.action[row], s1, p)
        terminated_out[row] = task.functions.terminated(s1, p)

    @task.kernel_for("advance")
    def advance_rows(
        t: task.Transition, memory_inout: wp.array2d[float], lasting_memory_inout: wp.array2d[float], first: int
    ):
        """Advance the task's memory along a rollout; launched over (nworld,), one thread for all steps of a world."""
        w = first + wp.tid()
        n, p = t.counters.step.shape[0], task.params_of(t, w)
        for i in range(t.action.shape[0] // n):
            row = i * n + w
            copy_row(memory_inout[row], memory_inout[row + n], 0, 1)
            copy_row(lasting_memory_inout[row], lasting_memory_inout[row + n], 0, 1)
            t.counters.rng[w, 0] = stream(t.counters.key[w], t.counters.episode[w], t.counters.step[w] + i + 1)
            s0, s1 = task.view(t.before, row), task.view(t.after, row)
            task.functions.advance(s0, t.action[row], s1, p, t.counters.rng[w])
