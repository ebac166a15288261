"""Make the kernels that call a task's functions for actions, restarts, events and shared memory."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import warp as wp

from lyceum_warp.core.done import FAULTS, Done
from lyceum_warp.kernels.random import stream, substream
from lyceum_warp.kernels.rollouts import control_of
from lyceum_warp.kernels.step_types import Counters, TaskCode
from lyceum_warp.kernels.transitions import judge_kernels, rollout_kernels

ACTION = wp.constant(int(Done.ACTION))
MODEL = wp.constant(int(Done.MODEL))
TERMINATED = wp.constant(int(Done.TERMINATED))
NAN = wp.constant(int(Done.NAN))
ALL_FAULTS = wp.constant(int(FAULTS))

EVENT = wp.constant(-2)
"""Number of the substream from which ``event`` draws."""
STARTUP = wp.constant(-1)
"""Replaces the episode number in the random stream of ``startup``."""


def act_kernels(task: TaskCode) -> None:
    """Make the kernels that map actions to controls, and the kernels that advance the task's memory."""
    Batch, Params = task.Batch, task.Params  # noqa: N806
    view, copy_state, valid_model = task.view, task.copy_state, task.valid_model
    control, advance, substep = (task.functions[name] for name in ("control", "advance", "substep"))
    has_control = "control" in task.written

    @task.kernel(task.has_state)
    def keep_before(after: Batch, before_out: Batch, lanes: int, first: int):
        """Save the fields that a step changes; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        copy_state(after, before_out, w, lane, lanes)

    @task.kernel()
    def act(
        batch: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
        range_in: wp.array2d[float],
        scale_in: wp.array2d[float],
        counters: Counters,
        safe_action_out: wp.array2d[float],
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
            safe_action_out[w, i] = wp.where(fault == 0, action_in[w, i], 0.0)
        if wp.static(has_control):
            control(view(batch, w), safe_action_out[w], params[w % params.shape[0]], ctrl_out[w])
            for i in range(ctrl_out.shape[1]):
                if wp.isnan(ctrl_out[w, i]):
                    fault = fault | NAN
                    ctrl_out[w, i] = 0.0
                ctrl_out[w, i] = wp.clamp(ctrl_out[w, i], range_in[i, 0], range_in[i, 1])
        else:
            for i in range(ctrl_out.shape[1]):
                ctrl_out[w, i] = control_of(safe_action_out[w, i], i, range_in, scale_in)
        fault_out[w] = fault
        counters.step[w] = counters.step[w] + 1

    @task.kernel(task.checks_model)
    def check_model(batch: Batch, fault_inout: wp.array[int], lanes: int, first: int):
        """Find faults in the model fields that the task writes; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        if not valid_model(view(batch, w), lane, lanes):
            fault_inout[w] = fault_inout[w] | MODEL

    @task.kernel_for("substep")
    def substep_memory(batch: Batch, params: wp.array[Params], first: int):
        """Advance the task's memory by one substep; launched over (nworld,)."""
        w = first + wp.tid()
        substep(view(batch, w), params[w % params.shape[0]])

    @task.kernel_for("advance")
    def advance_memory(
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
        counters: Counters,
        first: int,
    ):
        """Advance the task's memory by one step; launched over (nworld,)."""
        w = first + wp.tid()
        counters.rng[w, 0] = stream(counters.key[w], counters.episode[w], counters.step[w])
        p = params[w % params.shape[0]]
        advance(view(before, w), action_in[w], view(after, w), p, counters.rng[w])


@wp.kernel(enable_backward=False)
def hold_success(
    mask_in: wp.array[bool],
    transition: bool,
    needed: int,
    count_inout: wp.array2d[float],
    success_inout: wp.array[bool],
    first: int,
):
    """Report success only after ``needed`` successful steps in a row, in the masked worlds; launched over (nworld,).

    ``count``, (nworld, 1), holds the successful steps so far. A transition increases or clears the count; the
    evaluation of a state alone does not change the count.
    """
    w = first + wp.tid()
    if mask_in[w]:
        if transition:
            count_inout[w, 0] = wp.where(success_inout[w], wp.min(count_inout[w, 0] + 1.0, float(needed)), 0.0)
        success_inout[w] = success_inout[w] and count_inout[w, 0] >= float(needed)


def begin_kernels(task: TaskCode) -> None:
    """Make the kernels that begin episodes, randomize model fields, and run events between steps."""
    Batch, Params = task.Batch, task.Params  # noqa: N806
    view = task.view
    initialize, randomize, startup, reject, event = (
        task.functions[name] for name in ("initialize", "randomize", "startup", "reject", "event")
    )

    @task.kernel()
    def restart(
        mask_in: wp.array[bool],
        random: bool,
        again: bool,
        batch: Batch,
        params: wp.array[Params],
        counters: Counters,
        first: int,
    ):
        """Begin an episode in the masked worlds, or draw another initial state; launched over (nworld,).

        The engine has already reset these worlds to the fixed initial state. Another initial state is drawn with the
        next numbers of the world's random stream.
        """
        w = first + wp.tid()
        if not mask_in[w]:
            return
        if not again:
            counters.step[w] = 0
            counters.episode[w] = counters.episode[w] + 1
            counters.rng[w, 0] = stream(counters.key[w], counters.episode[w], 0)
        p = params[w % params.shape[0]]
        s = view(batch, w)
        initialize(s, p)
        if random:
            randomize(s, p, counters.rng[w])

    @task.kernel_for("reject")
    def reject_worlds(
        mask_in: wp.array[bool], batch: Batch, params: wp.array[Params], again_out: wp.array[bool], first: int
    ):
        """Find the masked worlds whose initial states are rejected; launched over (nworld,)."""
        w = first + wp.tid()
        again_out[w] = mask_in[w] and reject(view(batch, w), params[w % params.shape[0]])

    @task.kernel_for("startup")
    def start_worlds(mask_in: wp.array[bool], batch: Batch, params: wp.array[Params], counters: Counters, first: int):
        """Call ``startup`` in the masked worlds; launched over (nworld,)."""
        w = first + wp.tid()
        if mask_in[w]:
            counters.rng[w, 0] = stream(counters.key[w], STARTUP, 0)
            startup(view(batch, w), params[w % params.shape[0]], counters.rng[w])

    @task.kernel_for("event")
    def run_events(
        restarting_in: wp.array[bool],
        batch: Batch,
        params: wp.array[Params],
        counters: Counters,
        continuing_out: wp.array[bool],
        physics_changed_out: wp.array[bool],
        changed_out: wp.array[bool],
        outdated_out: wp.array[bool],
        first: int,
    ):
        """Set ``continuing_out`` for the worlds that do not restart, and run their events; launched over (nworld,)."""
        w = first + wp.tid()
        continuing_out[w] = not restarting_in[w]
        physics_changed_out[w] = False
        changed_out[w] = False
        outdated_out[w] = restarting_in[w]
        if not restarting_in[w]:
            at = stream(counters.key[w], counters.episode[w], counters.step[w])
            counters.rng[w, 0] = substream(at, EVENT)
            event(view(batch, w), params[w % params.shape[0]], counters.rng[w])


UNIT = wp.constant(2.0**20)
"""Sums over worlds are multiples of 1 / UNIT, so that they do not depend on the order of the worlds."""


def shared_kernels(task: TaskCode) -> None:
    """Make the kernels that sum and update the memory shared by all worlds."""
    Batch, Params, view = task.Batch, task.Params, task.view  # noqa: N806
    tally, share = task.functions["tally"], task.functions["share"]
    tells_failures = "tally" in task.written and "terminated" in tally.input_types
    view_sums, view_shared = task.views.get(task.Sums), task.views.get(task.Shared)

    @task.kernel_for("tally")
    def tally_worlds(
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
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
            s0, s1, p = view(before, w), view(after, w), params[w % params.shape[0]]
            ended, sums = reason_in[w] != 0, view_sums(share_out[w])
            if wp.static(tells_failures):
                tally(s0, action_in[w], s1, p, ended, sums, (reason_in[w] & TERMINATED) != 0)
            else:
                tally(s0, action_in[w], s1, p, ended, sums)
        for i in range(share_out.shape[1]):
            if share_out[w, i] != 0.0 and wp.isfinite(share_out[w, i]):
                wp.atomic_add(sum_inout, i, wp.int64(wp.round(wp.float64(share_out[w, i]) * wp.float64(UNIT))))

    @task.kernel_for("share")
    def share_memory(
        sum_inout: wp.array[wp.int64],
        sum_row_out: wp.array2d[float],
        params: wp.array[Params],
        shared_inout: wp.array2d[float],
        first: int,
    ):
        """Update the shared memory from the sums, and clear the sums; launched over (1,)."""
        for i in range(sum_inout.shape[0]):
            sum_row_out[0, i] = float(wp.float64(sum_inout[i]) / wp.float64(UNIT))
            sum_inout[i] = wp.int64(0)
        share(view_shared(shared_inout[0]), view_sums(sum_row_out[0]), params[0])


class Kernels(SimpleNamespace):
    """The kernels of a step by name; kernels that the task does not need are None."""

    views: Mapping[Any, wp.Function]
    """The functions that make the structs of the task.

    World is made from a batch and a world's index. The other structs are made from a row of floats.
    """
    terms: Mapping[str, wp.Function]
    """The generated functions of a task with terms: ``reward``, ``score`` and ``terminated``."""
    Batch: Any
    Observations: Any


def make_kernels(task: TaskCode) -> Kernels:
    """Make all kernels of a task."""
    for make in (act_kernels, judge_kernels, begin_kernels, rollout_kernels, shared_kernels):
        make(task)
    return Kernels(**task.kernels, views=task.views, terms=task.terms, Batch=task.Batch, Observations=task.Observations)
