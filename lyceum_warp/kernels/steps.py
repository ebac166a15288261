"""Make the kernels of a step that call a task's functions for actions, memory and events."""

import warp as wp

from lyceum_warp.core.done import Done
from lyceum_warp.kernels.random import stream, substream
from lyceum_warp.kernels.rollouts import control_of
from lyceum_warp.kernels.step_types import TaskCode

ACTION = wp.constant(int(Done.ACTION))
MODEL = wp.constant(int(Done.MODEL))
NAN = wp.constant(int(Done.NAN))

EVENT = wp.constant(-2)
"""Number of the substream from which ``event`` draws."""


def make_step_kernels(task: TaskCode) -> None:
    _make_keep_before(task)
    _make_act(task)
    _make_check_model(task)
    _make_substep_memory(task)
    _make_advance_memory(task)
    _make_run_events(task)


def _make_keep_before(task: TaskCode) -> None:
    @task.kernel(task.copy_state is not None)
    def keep_before(after: task.Batch, before_out: task.Batch, lanes: int, first: int):
        """Save the fields that a step changes; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        task.copy_state(after, before_out, w, lane, lanes)


def _make_act(task: TaskCode) -> None:
    @task.kernel()
    def act(
        t: task.Transition,
        action_in: wp.array2d[float],
        range_in: wp.array2d[float],
        scale_in: wp.array2d[float],
        fault_out: wp.array[int],
        ctrl_out: wp.array2d[float],
        first: int,
    ):
        """Map actions to controls, clipped to their ranges; launched over (nworld,).

        An action that is not finite becomes zero, and so does a NaN control, which clipping would replace by a bound.
        """
        w = first + wp.tid()
        fault = int(0)
        for i in range(action_in.shape[1]):
            if not wp.isfinite(action_in[w, i]):
                fault = ACTION
        for i in range(action_in.shape[1]):
            t.action[w, i] = wp.where(fault == 0, action_in[w, i], 0.0)
        if wp.static("control" in task.written):
            task.functions.control(task.view(t.after, w), t.action[w], task.params_of(t, w), ctrl_out[w])
            for i in range(ctrl_out.shape[1]):
                value = ctrl_out[w, i]
                if wp.isnan(value):
                    fault = fault | NAN
                ctrl_out[w, i] = wp.clamp(wp.where(wp.isnan(value), 0.0, value), range_in[i, 0], range_in[i, 1])
        else:
            for i in range(ctrl_out.shape[1]):
                ctrl_out[w, i] = control_of(t.action[w, i], i, range_in, scale_in)
        fault_out[w] = fault
        t.counters.step[w] = t.counters.step[w] + 1


def _make_check_model(task: TaskCode) -> None:
    @task.kernel(task.valid_model is not None)
    def check_model(batch: task.Batch, fault_inout: wp.array[int], lanes: int, first: int):
        """Find faults in the model fields that the task writes; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        if not task.valid_model(task.view(batch, w), lane, lanes):
            fault_inout[w] = fault_inout[w] | MODEL


def _make_substep_memory(task: TaskCode) -> None:
    @task.kernel_for("substep")
    def substep_memory(batch: task.Batch, params: wp.array[task.Params], first: int):
        """Advance the task's memory by one substep; launched over (nworld,)."""
        w = first + wp.tid()
        task.functions.substep(task.view(batch, w), params[w % params.shape[0]])


def _make_advance_memory(task: TaskCode) -> None:
    @task.kernel_for("advance")
    def advance_memory(t: task.Transition, first: int):
        """Advance the task's memory by one step; launched over (nworld,)."""
        w = first + wp.tid()
        t.counters.rng[w, 0] = stream(t.counters.key[w], t.counters.episode[w], t.counters.step[w])
        s0, s1 = task.view(t.before, w), task.view(t.after, w)
        task.functions.advance(s0, t.action[w], s1, task.params_of(t, w), t.counters.rng[w])


def _make_run_events(task: TaskCode) -> None:
    @task.kernel_for("event")
    def run_events(
        restarting_in: wp.array[bool],
        t: task.Transition,
        physics_changed_out: wp.array[bool],
        changed_out: wp.array[bool],
        outdated_out: wp.array[bool],
        first: int,
    ):
        """Run the events of the worlds that do not restart; launched over (nworld,)."""
        w = first + wp.tid()
        physics_changed_out[w] = False
        changed_out[w] = False
        outdated_out[w] = restarting_in[w]
        if not restarting_in[w]:
            at = stream(t.counters.key[w], t.counters.episode[w], t.counters.step[w])
            t.counters.rng[w, 0] = substream(at, EVENT)
            task.functions.event(task.view(t.after, w), task.params_of(t, w), t.counters.rng[w])
