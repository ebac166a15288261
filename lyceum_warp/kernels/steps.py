"""The kernels of one step, around the functions of a task."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any

import warp as wp

from lyceum_warp.done import Done
from lyceum_warp.kernels import faults
from lyceum_warp.kernels.random import stream, substream
from lyceum_warp.kernels.rows import copy_row

TERMINATED = wp.constant(int(Done.TERMINATED))
TRUNCATED = wp.constant(int(Done.TRUNCATED))
ACTION = wp.constant(int(Done.ACTION))
REWARD = wp.constant(int(Done.REWARD))
OBSERVATION = wp.constant(int(Done.OBSERVATION))
MODEL = wp.constant(int(Done.MODEL))
NAN = wp.constant(int(Done.NAN))

# streams that begin at the place of one step; ``advance`` draws from that place itself
OBSERVE = wp.constant(-1)
EVENT = wp.constant(-2)
STARTUP = wp.constant(-1)
"""Stands in for the number of an episode."""

# the parts of a judgement; the groups of observations follow
ENDS = wp.constant(0)
GAIN = wp.constant(1)
METRICS = wp.constant(2)
OBSERVE_FIRST = wp.constant(3)


@wp.struct
class Counters:
    """The counters of each world; every array is (nworld,)."""

    step: wp.array[int]
    """Steps since the reset."""
    key: wp.array[wp.uint32]
    """Key of the world's random streams."""
    episode: wp.array[int]
    """Number of the episode."""
    rng: wp.array2d[wp.uint32]
    """The random stream that a task's function draws from, (groups of observations * nworld, 1), a row for each
    thread that draws; every kernel starts it again."""


@wp.struct
class Outcome:
    """The outcome of a step in each world; every array is (nworld,), metrics are (nworld, nmetrics)."""

    reward: wp.array[float]
    eval: wp.array[float]
    terminated: wp.array[bool]
    truncated: wp.array[bool]
    success: wp.array[bool]
    done: wp.array[bool]
    done_reason: wp.array[int]
    metrics: wp.array2d[float]
    episode_metrics: wp.array2d[float]


@wp.struct
class Findings:
    """What the parts of a judgement find before it is known whether a world has a fault; every array is (nworld,)."""

    reward: wp.array[float]
    eval: wp.array[float]
    terminated: wp.array[bool]
    success: wp.array[bool]
    fault: wp.array2d[int]
    """Faults found by each part, (parts, nworld)."""


OUTCOMES = {
    "reward": wp.float32,
    "eval": wp.float32,
    "terminated": wp.bool,
    "truncated": wp.bool,
    "success": wp.bool,
    "done": wp.bool,
    "done_reason": wp.int32,
}
"""The fields of Outcome with one number a world, and their types."""


@wp.kernel(enable_backward=False)
def hold_success(
    mask_in: wp.array[bool],
    transition: bool,
    needed: int,
    count_inout: wp.array2d[float],
    success_inout: wp.array[bool],
    first: int,
):
    """Let a success count only after ``needed`` steps in a row, in the masked worlds; launched over (nworld,).

    A transition goes on with the count, (nworld, 1), up to ``needed``, or clears it; a state alone keeps it.
    """
    w = first + wp.tid()
    if mask_in[w]:
        if transition:
            count_inout[w, 0] = wp.where(success_inout[w], wp.min(count_inout[w, 0] + 1.0, float(needed)), 0.0)
        success_inout[w] = success_inout[w] and count_inout[w, 0] >= float(needed)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskCode:
    """A task's structs and functions, with those that are generated around them for all worlds.

    Args:
        module: Name of the Warp module that the kernels are compiled into, one for each task.
        functions: The task's functions by name, with defaults for those that it does not have.
        written: Names of the functions that the task has. Without ``control`` a scale and an offset map actions to
            controls; without ``evaluate`` the evaluation is the reward; without ``advance`` memory stays as it is.
        World: The task's struct of one world's fields.
        Params: The task's struct of parameters.
        Batch: A struct of the task's fields for all worlds.
        Observations: A struct of the groups of observations.
        view: The function from (batch, world) to ``World``.
        copy_state: Copies what steps change.
        observe_group: Writes a group of observations.
        finite_group: Whether a group of observations is finite.
        copy_observations: Copies all groups.
        finite_memory: Whether the task's memory is finite.
        valid_model: Whether the model fields that the task writes are valid.
        has_state: Whether ``copy_state`` has anything to do.
        has_memory: Whether ``finite_memory`` has.
        checks_model: Whether ``valid_model`` has.
    """

    module: str
    functions: Mapping[str, wp.Function]
    written: Collection[str]
    World: Any
    Params: Any
    Batch: Any
    Observations: Any
    view: wp.Function
    copy_state: wp.Function
    observe_group: wp.Function
    finite_group: wp.Function
    copy_observations: wp.Function
    finite_memory: wp.Function
    valid_model: wp.Function
    has_state: bool
    has_memory: bool
    checks_model: bool

    def kernel(self, needed: bool = True) -> Callable[[Any], Any]:
        """Decorator: a kernel of the task's module, or None for tasks that do not need it."""
        return wp.kernel(module=self.module, enable_backward=False) if needed else lambda body: None

    def kernel_for(self, function: str) -> Callable[[Any], Any]:
        """Decorator: a kernel for tasks that have a function, and None for the others."""
        return self.kernel(function in self.written)


@dataclasses.dataclass(frozen=True)
class ActKernels:
    """From an action to controls, substeps and the task's memory."""

    keep_before: wp.Kernel | None
    act: wp.Kernel
    check_model: wp.Kernel | None
    control_worlds: wp.Kernel | None
    substep_memory: wp.Kernel | None
    advance_memory: wp.Kernel | None


def act_kernels(task: TaskCode) -> ActKernels:
    """Make the kernels of ``ActKernels`` around a task's functions."""
    Batch, Params = task.Batch, task.Params  # noqa: N806
    view, copy_state, valid_model = task.view, task.copy_state, task.valid_model
    control, advance, substep = (task.functions[name] for name in ("control", "advance", "substep"))
    has_control = "control" in task.written

    @task.kernel(task.has_state)
    def keep_before(after: Batch, before_out: Batch, lanes: int, first: int):
        """Copy the fields that a step changes; launched over (nworld, lanes)."""
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

        An action that is not finite counts as zero, and so does a control that is not-a-number, which clipping would
        turn into a bound.
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
        else:
            for i in range(ctrl_out.shape[1]):
                ctrl_out[w, i] = safe_action_out[w, i] * scale_in[i, 0] + scale_in[i, 1]
        for i in range(ctrl_out.shape[1]):
            ctrl_out[w, i] = wp.clamp(ctrl_out[w, i], range_in[i, 0], range_in[i, 1])
        fault_out[w] = fault
        counters.step[w] = counters.step[w] + 1

    @task.kernel(task.checks_model)
    def check_model(batch: Batch, fault_inout: wp.array[int], lanes: int, first: int):
        """Find faults of the model fields that the task writes; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        if not valid_model(view(batch, w), lane, lanes):
            fault_inout[w] = fault_inout[w] | MODEL

    @task.kernel_for("control")
    def control_worlds(
        batch: Batch, params: wp.array[Params], action_in: wp.array2d[float], ctrl_out: wp.array2d[float], first: int
    ):
        """Turn actions into controls and inputs, and nothing else; launched over (nworld,)."""
        w = first + wp.tid()
        control(view(batch, w), action_in[w], params[w % params.shape[0]], ctrl_out[w])

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

    return ActKernels(keep_before, act, check_model, control_worlds, substep_memory, advance_memory)


@dataclasses.dataclass(frozen=True)
class JudgeKernels:
    """Transitions and states: rewards, ends, metrics and observations."""

    check_memory: wp.Kernel | None
    judge: wp.Kernel
    conclude: wp.Kernel
    observe_worlds: wp.Kernel
    replace_observations: wp.Kernel
    measure_worlds: wp.Kernel | None


def judge_kernels(task: TaskCode) -> JudgeKernels:
    """Make the kernels of ``JudgeKernels`` around a task's functions."""
    Batch, Params, Observations, World = task.Batch, task.Params, task.Observations, task.World  # noqa: N806
    view, finite_memory = task.view, task.finite_memory
    finite_group, copy_observations = task.finite_group, task.copy_observations
    reward, measure, evaluate, terminated, success = (
        task.functions[name] for name in ("reward", "measure", "evaluate", "terminated", "success")
    )
    has_evaluate, has_measure = "evaluate" in task.written, "measure" in task.written
    observe_group = task.observe_group

    @wp.func
    def observe(group: int, s: World, p: Params, out: Observations, w: int, counters: Counters):
        """Write a group of observations; its noise is a function of the counters alone."""
        base = substream(stream(counters.key[w], counters.episode[w], counters.step[w]), OBSERVE)
        observe_group(group, s, p, out, w, base, counters.rng[group * counters.step.shape[0] + w])

    @task.kernel(task.has_memory)
    def check_memory(
        mask_in: wp.array[bool], before: Batch, after: Batch, fault_inout: wp.array[int], lanes: int, first: int
    ):
        """Find faults of the task's memory in the masked worlds; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        if mask_in[w] and not finite_memory(view(before, w), view(after, w), lane, lanes):
            fault_inout[w] = fault_inout[w] | NAN

    @task.kernel()
    def judge(
        mask_in: wp.array[bool],
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
        counters: Counters,
        transition: bool,
        fault_in: wp.array[int],
        action_fault_in: wp.array[int],
        found_out: Findings,
        metrics_out: wp.array2d[float],
        obs_out: Observations,
        threads: int,
        first: int,
    ):
        """Judge a transition, or a state alone, in the masked worlds; launched over (threads, nworld).

        The parts do not depend on each other. On a GPU each has a thread of its own, because one after the other they
        take several times as long, and there are places for far more threads than worlds. A world that has a fault
        already is not judged.
        """
        start, k = wp.tid()
        w = first + k
        if not mask_in[w]:
            return
        for part in range(start, found_out.fault.shape[0], threads):
            found = int(0)
            if (fault_in[w] | action_fault_in[w]) == 0:
                p = params[w % params.shape[0]]
                s1 = view(after, w)
                if part == ENDS:
                    found_out.terminated[w] = terminated(s1, p)
                    found_out.success[w] = success(s1, p)
                    if wp.static(has_evaluate):
                        found_out.eval[w] = evaluate(s1, p)
                elif part == GAIN:
                    if transition:
                        found_out.reward[w] = reward(view(before, w), action_in[w], s1, p)
                        if not wp.isfinite(found_out.reward[w]):
                            found = REWARD
                elif part == METRICS:
                    if wp.static(has_measure):
                        for i in range(metrics_out.shape[1]):
                            metrics_out[w, i] = 0.0
                        if transition:
                            measure(view(before, w), action_in[w], s1, p, metrics_out[w])
                else:
                    group = part - OBSERVE_FIRST
                    observe(group, s1, p, obs_out, w, counters)
                    if not finite_group(group, obs_out, w):
                        found = OBSERVATION
            found_out.fault[part, w] = found

    @task.kernel()
    def conclude(
        mask_in: wp.array[bool],
        before: Batch,
        params: wp.array[Params],
        found: Findings,
        step_in: wp.array[int],
        horizon: int,
        transition: bool,
        keep_reason: bool,
        fault_inout: wp.array[int],
        action_fault_in: wp.array[int],
        out: Outcome,
        metric_sum_inout: wp.array2d[float],
        obs_out: Observations,
        final_obs_inout: Observations,
        restart_out: wp.array[bool],
        fault_count_inout: wp.array2d[int],
        lanes: int,
        first: int,
    ):
        """Put together what ``judge`` found in the masked worlds; launched over (nworld, lanes).

        Writes the reward, the metrics and their sums, the evaluation, the ends, success and the observations. The
        lanes of a world share its rows.

        A transition with a fault has reward 0, metrics 0, the evaluation of the state before it, and the last good
        observations. It counts as truncated, so that learners bootstrap from those observations.

        Only a transition ends an episode: the ends of a state alone are those that it was saved with (``keep_reason``),
        and ``found.terminated`` says whether the task's ``terminated`` holds in it.
        """
        k, lane = wp.tid()
        w = first + k
        if not mask_in[w]:
            return
        fault = fault_inout[w] | action_fault_in[w]
        for part in range(found.fault.shape[0]):
            fault = fault | found.fault[part, w]
        if fault == 0:
            copy_observations(final_obs_inout, obs_out, w, lane, lanes)
        else:
            copy_observations(obs_out, final_obs_inout, w, lane, lanes)
        if wp.static(has_measure):
            for i in range(lane, out.metrics.shape[1], lanes):
                if fault != 0 or not transition:
                    out.metrics[w, i] = 0.0
                if wp.isfinite(out.metrics[w, i]):  # the sum belongs to the state, which is finite
                    metric_sum_inout[w, i] = metric_sum_inout[w, i] + out.metrics[w, i]
                out.episode_metrics[w, i] = metric_sum_inout[w, i]
        if lane > 0:
            return
        fault_inout[w] = fault
        gain = float(0.0)
        if fault == 0 and transition:
            gain = found.reward[w]
        out.reward[w] = gain
        if wp.static(has_evaluate):
            if fault == 0:
                out.eval[w] = found.eval[w]
            elif transition:
                found.eval[w] = evaluate(view(before, w), params[w % params.shape[0]])
                if not faults.is_out_of_range(found.eval[w]):  # else keep the evaluation of an earlier state
                    out.eval[w] = found.eval[w]
        else:
            out.eval[w] = gain
        found.terminated[w] = fault == 0 and found.terminated[w]
        out.success[w] = fault == 0 and found.success[w]
        reason = int(0)
        if transition:
            reason = fault
            if found.terminated[w]:
                reason = TERMINATED
            if horizon > 0 and step_in[w] >= horizon:
                reason = reason | TRUNCATED
        if keep_reason:
            reason = reason | out.done_reason[w]
        out.done_reason[w] = reason
        out.terminated[w] = (reason & TERMINATED) != 0
        out.truncated[w] = (reason & ~TERMINATED) != 0
        out.done[w] = reason != 0
        if transition:
            # without automatic resets a world steps on after its end, but not after a fault
            restart_out[w] = wp.where(keep_reason, fault != 0, reason != 0)
            if fault != 0:
                faults.count_faults(fault, fault_count_inout[w])

    @task.kernel()
    def observe_worlds(
        mask_in: wp.array[bool],
        batch: Batch,
        params: wp.array[Params],
        counters: Counters,
        good_in: Observations,
        finite_out: wp.array2d[bool],
        obs_out: Observations,
        parts: int,
        first: int,
    ):
        """Observe the masked worlds, and find the groups whose numbers are finite; launched over (parts, nworld).

        With one part for all groups it replaces what is not finite as well; else ``replace_observations`` must follow.
        """
        start, k = wp.tid()
        w = first + k
        if mask_in[w]:
            finite = bool(True)
            for group in range(start, finite_out.shape[0], parts):
                observe(group, view(batch, w), params[w % params.shape[0]], obs_out, w, counters)
                finite_out[group, w] = finite_group(group, obs_out, w)
                finite = finite and finite_out[group, w]
            if parts == 1 and not finite:
                copy_observations(good_in, obs_out, w, 0, 1)

    @task.kernel()
    def replace_observations(
        mask_in: wp.array[bool],
        finite_in: wp.array2d[bool],
        good_in: Observations,
        obs_inout: Observations,
        lanes: int,
        first: int,
    ):
        """Put the last good observations where a number is not finite; launched over (nworld, lanes).

        Such a number is a fault of the next step.
        """
        k, lane = wp.tid()
        w = first + k
        if mask_in[w]:
            finite = bool(True)
            for group in range(finite_in.shape[0]):
                finite = finite and finite_in[group, w]
            if not finite:
                copy_observations(good_in, obs_inout, w, lane, lanes)

    @task.kernel_for("measure")
    def measure_worlds(
        batch: Batch, params: wp.array[Params], action_in: wp.array2d[float], metrics_out: wp.array2d[float], first: int
    ):
        """Measure transitions from states to themselves; launched over (nworld,)."""
        w = first + wp.tid()
        s = view(batch, w)
        measure(s, action_in[w], s, params[w % params.shape[0]], metrics_out[w])

    return JudgeKernels(check_memory, judge, conclude, observe_worlds, replace_observations, measure_worlds)


@dataclasses.dataclass(frozen=True)
class BeginKernels:
    """New episodes, and what is drawn in them or happens between two steps."""

    restart: wp.Kernel
    reject_worlds: wp.Kernel | None
    start_worlds: wp.Kernel | None
    run_events: wp.Kernel | None


def begin_kernels(task: TaskCode) -> BeginKernels:
    """Make the kernels of ``BeginKernels`` around a task's functions."""
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
        """Begin an episode in the masked worlds, or draw its initial state again; launched over (nworld,).

        The engine has already put them into the fixed initial state. A further draw goes on in the stream of the last.
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
        """Find the masked worlds whose initial state must be drawn again; launched over (nworld,)."""
        w = first + wp.tid()
        again_out[w] = mask_in[w] and reject(view(batch, w), params[w % params.shape[0]])

    @task.kernel_for("startup")
    def start_worlds(mask_in: wp.array[bool], batch: Batch, params: wp.array[Params], counters: Counters, first: int):
        """Draw the model fields of the masked worlds once; launched over (nworld,)."""
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
        """Run the events of the worlds that do not restart, ``continuing_out``; launched over (nworld,)."""
        w = first + wp.tid()
        continuing_out[w] = not restarting_in[w]
        physics_changed_out[w] = False
        changed_out[w] = False
        outdated_out[w] = restarting_in[w]
        if not restarting_in[w]:
            at = stream(counters.key[w], counters.episode[w], counters.step[w])
            counters.rng[w, 0] = substream(at, EVENT)
            event(view(batch, w), params[w % params.shape[0]], counters.rng[w])

    return BeginKernels(restart, reject_worlds, start_worlds, run_events)


@dataclasses.dataclass(frozen=True)
class RolloutKernels:
    """Open-loop rollouts, which keep their fields for all steps."""

    judge_rows: wp.Kernel
    advance_rows: wp.Kernel | None


def rollout_kernels(task: TaskCode) -> RolloutKernels:
    """Make the kernels of ``RolloutKernels`` around a task's functions.

    Row t * nworld + w is world w after t steps. The transition of that row leads to the one nworld further, so
    ``before`` and ``after`` are the same arrays, shifted.
    """
    Batch, Params = task.Batch, task.Params  # noqa: N806
    view = task.view
    reward, terminated, advance = (task.functions[name] for name in ("reward", "terminated", "advance"))

    @task.kernel()
    def judge_rows(
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
        reward_out: wp.array[float],
        terminated_out: wp.array[bool],
        first: int,
    ):
        """Compute reward and termination of a rollout's transitions; launched over (steps * nworld,)."""
        row = first + wp.tid()
        p = params[row % params.shape[0]]
        s1 = view(after, row)
        reward_out[row] = reward(view(before, row), action_in[row], s1, p)
        terminated_out[row] = terminated(s1, p)

    @task.kernel_for("advance")
    def advance_rows(
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
        counters: Counters,
        memory_inout: wp.array2d[float],
        lasting_memory_inout: wp.array2d[float],
        first: int,
    ):
        """Advance the task's memory along a rollout; launched over (nworld,), one thread for all steps of a world."""
        w = first + wp.tid()
        n = counters.step.shape[0]
        p = params[w % params.shape[0]]
        for t in range(action_in.shape[0] // n):
            row = t * n + w
            copy_row(memory_inout[row], memory_inout[row + n], 0, 1)
            copy_row(lasting_memory_inout[row], lasting_memory_inout[row + n], 0, 1)
            counters.rng[w, 0] = stream(counters.key[w], counters.episode[w], counters.step[w] + t + 1)
            advance(view(before, row), action_in[row], view(after, row), p, counters.rng[w])

    return RolloutKernels(judge_rows, advance_rows)


@dataclasses.dataclass(frozen=True)
class Kernels(ActKernels, JudgeKernels, BeginKernels, RolloutKernels):
    """The kernels of a step, and the structs of their arrays. None stands for a kernel that the task does not need."""

    Batch: Any
    Observations: Any


def make_kernels(task: TaskCode) -> Kernels:
    """Fuse a task's functions into the kernels of a step."""
    parts = (make(task) for make in (act_kernels, judge_kernels, begin_kernels, rollout_kernels))
    kernels = {name: kernel for part in parts for name, kernel in vars(part).items()}
    return Kernels(**kernels, Batch=task.Batch, Observations=task.Observations)
