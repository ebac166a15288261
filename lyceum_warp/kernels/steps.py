"""Make the kernels of a step around the functions of a task: clip actions, judge transitions, begin episodes."""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from typing import Any

import warp as wp

from lyceum_warp.done import FAULTS, Done
from lyceum_warp.kernels import faults
from lyceum_warp.kernels.random import stream, substream
from lyceum_warp.kernels.rows import copy_row

TERMINATED = wp.constant(int(Done.TERMINATED))
TRUNCATED = wp.constant(int(Done.TRUNCATED))
ACTION = wp.constant(int(Done.ACTION))
REWARD = wp.constant(int(Done.REWARD))
OBSERVATION = wp.constant(int(Done.OBSERVATION))
MODEL = wp.constant(int(Done.MODEL))
ALL_FAULTS = wp.constant(int(FAULTS))
NAN = wp.constant(int(Done.NAN))

# substreams of a step's stream; ``advance`` draws from the stream itself
OBSERVE = wp.constant(-1)
EVENT = wp.constant(-2)
STARTUP = wp.constant(-1)
"""Replaces the episode number."""

# the parts that ``judge`` computes; the observation groups follow
ENDS = wp.constant(0)
GAIN = wp.constant(1)
METRICS = wp.constant(2)
OBSERVE_FIRST = wp.constant(3)


@wp.struct
class Counters:
    """Counters and random streams of the worlds; every array is (nworld,) unless noted."""

    step: wp.array[int]
    """Steps since the reset."""
    key: wp.array[wp.uint32]
    """Key of the world's random streams."""
    episode: wp.array[int]
    """Index of the episode."""
    rng: wp.array2d[wp.uint32]
    """Stream that a task's function draws from, (observation groups * nworld, 1), with one row per drawing thread.
    Every kernel resets it to its start."""


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
    """Results of ``judge``, before it is known whether a world has a fault; every array is (nworld,)."""

    reward: wp.array[float]
    eval: wp.array[float]
    terminated: wp.array[bool]
    success: wp.array[bool]
    fault: wp.array2d[int]
    """Faults of each part, (parts, nworld)."""


OUTCOMES = {
    "reward": wp.float32,
    "eval": wp.float32,
    "terminated": wp.bool,
    "truncated": wp.bool,
    "success": wp.bool,
    "done": wp.bool,
    "done_reason": wp.int32,
}
"""Types of the fields of Outcome that are (nworld,)."""


@wp.kernel(enable_backward=False)
def hold_success(
    mask_in: wp.array[bool],
    transition: bool,
    needed: int,
    count_inout: wp.array2d[float],
    success_inout: wp.array[bool],
    first: int,
):
    """Report success only after ``needed`` consecutive steps, in the masked worlds; launched over (nworld,).

    A transition increases or clears the count, (nworld, 1). Judging a state without a transition keeps it.
    """
    w = first + wp.tid()
    if mask_in[w]:
        if transition:
            count_inout[w, 0] = wp.where(success_inout[w], wp.min(count_inout[w, 0] + 1.0, float(needed)), 0.0)
        success_inout[w] = success_inout[w] and count_inout[w, 0] >= float(needed)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TaskCode:
    """A task's structs and functions, and the functions that are generated from them.

    Without ``control``, actions are scaled and shifted to controls. Without ``evaluate``, the evaluation is the reward.
    Without ``advance``, the memory does not change.
    """

    module: str  # name of the task's Warp module
    functions: Mapping[str, wp.Function]  # functions by name, including defaults
    written: Collection[str]  # names of the functions that the task defines
    World: Any
    Params: Any
    Batch: Any  # struct of the task's fields in all worlds
    Observations: Any  # struct of the observation groups
    Shared: Any  # struct of the memory that worlds share, or None
    Sums: Any  # struct of the sums over worlds, or None
    view: wp.Function  # (batch, world) -> World
    views: Mapping[Any, wp.Function]  # ``Kernels.views``
    copy_state: wp.Function  # copies the fields that steps change
    observe_group: wp.Function
    finite_group: wp.Function
    copy_observations: wp.Function
    finite_memory: wp.Function
    valid_model: wp.Function  # whether the model fields that the task writes are valid
    terms: Mapping[
        str, wp.Function
    ]  # ``reward``, ``score`` and ``terminated`` of a task with terms; see ``binding.task_terms``
    has_state: bool  # whether ``copy_state`` is needed
    has_memory: bool  # whether ``finite_memory`` is needed
    checks_model: bool  # whether ``valid_model`` is needed

    def kernel(self, needed: bool = True) -> Callable[[Any], Any]:
        """Decorator: make a kernel in the task's module, or None if it is not needed."""
        return wp.kernel(module=self.module, enable_backward=False) if needed else lambda body: None

    def kernel_for(self, function: str) -> Callable[[Any], Any]:
        """Decorator: make a kernel if the task has a function, else None."""
        return self.kernel(function in self.written)


@dataclasses.dataclass(frozen=True)
class ActKernels:
    """Kernels that map actions to controls and advance the task's memory."""

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
        else:
            for i in range(ctrl_out.shape[1]):
                ctrl_out[w, i] = safe_action_out[w, i] * scale_in[i, 0] + scale_in[i, 1]
        for i in range(ctrl_out.shape[1]):
            ctrl_out[w, i] = wp.clamp(ctrl_out[w, i], range_in[i, 0], range_in[i, 1])
        fault_out[w] = fault
        counters.step[w] = counters.step[w] + 1

    @task.kernel(task.checks_model)
    def check_model(batch: Batch, fault_inout: wp.array[int], lanes: int, first: int):
        """Find faults in the model fields that the task writes; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        if not valid_model(view(batch, w), lane, lanes):
            fault_inout[w] = fault_inout[w] | MODEL

    @task.kernel_for("control")
    def control_worlds(
        batch: Batch, params: wp.array[Params], action_in: wp.array2d[float], ctrl_out: wp.array2d[float], first: int
    ):
        """Call only the task's ``control``; launched over (nworld,)."""
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
    """Kernels that compute rewards, ends of episodes, metrics and observations."""

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
    score, has_score = task.terms.get("score"), "score" in task.terms
    has_evaluate, has_measure = "evaluate" in task.written, "measure" in task.written
    has_metrics = has_measure or has_score
    observe_group = task.observe_group

    @wp.func
    def observe(group: int, s: World, p: Params, out: Observations, w: int, counters: Counters):
        """Write an observation group; its noise depends only on the counters."""
        base = substream(stream(counters.key[w], counters.episode[w], counters.step[w]), OBSERVE)
        observe_group(group, s, p, out, w, base, counters.rng[group * counters.step.shape[0] + w])

    @task.kernel(task.has_memory)
    def check_memory(
        mask_in: wp.array[bool], before: Batch, after: Batch, fault_inout: wp.array[int], lanes: int, first: int
    ):
        """Find faults in the task's memory, in the masked worlds; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        if mask_in[w] and not finite_memory(before, after, w, lane, lanes):
            fault_inout[w] = fault_inout[w] | NAN

    @task.kernel()
    def judge(
        mask_in: wp.array[bool],
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        weights_in: wp.array2d[float],
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
        """Evaluate a transition or a state in the masked worlds without a fault; launched over (threads, nworld).

        The parts are independent. On a GPU each part runs in a separate thread, which is several times faster than one
        thread per world.
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
                    if wp.static(has_score):
                        for i in range(metrics_out.shape[1]):
                            metrics_out[w, i] = 0.0
                    if transition:
                        if wp.static(has_score):
                            weights = weights_in[w % weights_in.shape[0]]
                            found_out.reward[w] = score(view(before, w), action_in[w], s1, p, weights, metrics_out[w])
                        else:
                            found_out.reward[w] = reward(view(before, w), action_in[w], s1, p)
                        if not wp.isfinite(found_out.reward[w]):
                            found = REWARD
                elif part == METRICS:
                    if wp.static(has_measure and not has_score):
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
        """Combine the results of ``judge`` in the masked worlds; launched over (nworld, lanes).

        Writes the reward, the metrics and their sums, the evaluation, the end of the episode, success and the
        observations. A transition with a fault has reward 0, metrics 0, the evaluation of the state before it, and the
        last good observations. It counts as truncated, so that learners bootstrap from those observations.

        Only a transition ends an episode. For a state without a transition, ``keep_reason`` keeps the saved reason, and
        ``found.terminated`` shows whether the task's ``terminated`` holds.
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
        if wp.static(has_metrics):
            for i in range(lane, out.metrics.shape[1], lanes):
                if fault != 0 or not transition:
                    out.metrics[w, i] = 0.0
                if wp.isfinite(out.metrics[w, i]):  # the sum is part of the state, which must be finite
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
                if not faults.is_out_of_range(found.eval[w]):  # else keep the previous evaluation
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
            # without automatic resets a world continues after its episode's end, but not after a fault
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
        """Observe the masked worlds, and find the groups that are finite; launched over (parts, nworld).

        With one part it also replaces observations that are not finite; else ``replace_observations`` must follow.
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
        """Replace observations that are not finite by the last good ones; launched over (nworld, lanes).

        The next step reports the fault.
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
    """Kernels that begin episodes, randomize model fields, and run events between steps."""

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

        The engine has already reset these worlds to the fixed initial state. A repeated draw continues the stream.
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
    """Kernels for open-loop rollouts, which store their fields for all steps."""

    judge_rows: wp.Kernel
    advance_rows: wp.Kernel | None


def rollout_kernels(task: TaskCode) -> RolloutKernels:
    """Make the kernels of ``RolloutKernels`` around a task's functions.

    Row t * nworld + w is world w after t steps. The next state is nworld rows later, so ``before`` and ``after`` are
    views of the same arrays.
    """
    Batch, Params = task.Batch, task.Params  # noqa: N806
    view = task.view
    reward, terminated, advance = (task.functions[name] for name in ("reward", "terminated", "advance"))
    sum_of_terms, has_terms = task.terms.get("reward"), "reward" in task.terms

    @task.kernel()
    def judge_rows(
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        weights_in: wp.array2d[float],
        action_in: wp.array2d[float],
        reward_out: wp.array[float],
        terminated_out: wp.array[bool],
        first: int,
    ):
        """Compute reward and termination of a rollout's transitions; launched over (steps * nworld,)."""
        row = first + wp.tid()
        p = params[row % params.shape[0]]
        s1 = view(after, row)
        if wp.static(has_terms):
            weights = weights_in[row % weights_in.shape[0]]
            reward_out[row] = sum_of_terms(view(before, row), action_in[row], s1, p, weights)
        else:
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


UNIT = wp.constant(2.0**20)
"""Sums over worlds are whole multiples of 1 / UNIT, so that they do not depend on the order of the worlds."""


@dataclasses.dataclass(frozen=True)
class SharedKernels:
    """Kernels for the memory that all worlds share."""

    tally_worlds: wp.Kernel | None
    share_memory: wp.Kernel | None


def shared_kernels(task: TaskCode) -> SharedKernels:
    """Make the kernels of ``SharedKernels`` around a task's functions."""
    Batch, Params, view = task.Batch, task.Params, task.view  # noqa: N806
    tally, share = task.functions["tally"], task.functions["share"]
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
        """Add each world's share of a transition without a fault to the sums; launched over (nworld,)."""
        w = first + wp.tid()
        for i in range(share_out.shape[1]):
            share_out[w, i] = 0.0
        if (reason_in[w] & ALL_FAULTS) == 0:
            p = params[w % params.shape[0]]
            tally(view(before, w), action_in[w], view(after, w), p, reason_in[w] != 0, view_sums(share_out[w]))
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
        """Update the shared memory from the sums, and clear these; launched over (1,)."""
        for i in range(sum_inout.shape[0]):
            sum_row_out[0, i] = float(wp.float64(sum_inout[i]) / wp.float64(UNIT))
            sum_inout[i] = wp.int64(0)
        share(view_shared(shared_inout[0]), view_sums(sum_row_out[0]), params[0])

    return SharedKernels(tally_worlds, share_memory)


@dataclasses.dataclass(frozen=True)
class Kernels(ActKernels, JudgeKernels, BeginKernels, RolloutKernels, SharedKernels):
    """The kernels of a step, and the structs of their arrays. Kernels that the task does not need are None."""

    views: Mapping[Any, wp.Function]
    """For each struct of the task, the function that makes it: World from a batch and a world's index, observation
    structs from a row."""
    terms: Mapping[str, wp.Function]
    """The generated functions of a task with terms: ``reward``, ``score`` and ``terminated``."""
    Batch: Any
    Observations: Any


def make_kernels(task: TaskCode) -> Kernels:
    """Make all kernels of a task."""
    parts = (make(task) for make in (act_kernels, judge_kernels, begin_kernels, rollout_kernels, shared_kernels))
    kernels = {name: kernel for part in parts for name, kernel in vars(part).items()}
    return Kernels(**kernels, views=task.views, terms=task.terms, Batch=task.Batch, Observations=task.Observations)
