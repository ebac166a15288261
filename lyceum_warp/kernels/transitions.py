"""Make the kernels that compute rewards, metrics and observations, and decide whether an episode ends."""

import warp as wp

from lyceum_warp.core.done import Done
from lyceum_warp.kernels import faults
from lyceum_warp.kernels.random import stream, substream
from lyceum_warp.kernels.rows import copy_row
from lyceum_warp.kernels.step_types import Counters, Findings, Outcome, TaskCode

TERMINATED = wp.constant(int(Done.TERMINATED))
TRUNCATED = wp.constant(int(Done.TRUNCATED))
REWARD = wp.constant(int(Done.REWARD))
OBSERVATION = wp.constant(int(Done.OBSERVATION))
NAN = wp.constant(int(Done.NAN))

OBSERVE = wp.constant(-1)
"""Number of the substream from which observation noise is drawn."""

# the parts of ``judge``; from OBSERVE_FIRST on, each observation group is a part
ENDS = wp.constant(0)
GAIN = wp.constant(1)
METRICS = wp.constant(2)
OBSERVE_FIRST = wp.constant(3)


def judge_kernels(task: TaskCode) -> None:
    """Make the kernels that compute rewards, ends of episodes, metrics and observations."""
    Batch, Params, Observations, World = task.Batch, task.Params, task.Observations, task.World  # noqa: N806
    view, finite_memory = task.view, task.finite_memory
    valid_group, copy_observations = task.valid_group, task.copy_observations
    reward, measure, evaluate, terminated, truncated, success = (
        task.functions[name] for name in ("reward", "measure", "evaluate", "terminated", "truncated", "success")
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
        """Evaluate a transition or a state, in masked worlds that have no fault; launched over (threads, nworld).

        The work has independent parts: the end of the episode, the reward, the metrics, and each observation group. On
        a GPU each part runs in a separate thread, which is several times faster than one thread per world.
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
                    found_out.truncated[w] = truncated(s1, p)
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
                        if faults.is_out_of_range(found_out.reward[w]):
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
                    if not valid_group(group, obs_out, w):
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

        The kernel writes the reward, the metrics and their sums, the evaluation, the end of the episode, success and
        the observations. A transition with a fault has reward 0, metrics 0, the evaluation of the state before it, and
        the last good observations. Such a transition counts as truncated, so that learners bootstrap from the
        last good observations.

        If ``transition`` is not set, the kernel evaluates a state and ends no episode. ``found.terminated`` then holds
        the result of the task's ``terminated``. ``keep_reason`` keeps the done reasons that are already stored.
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
            if (horizon > 0 and step_in[w] >= horizon) or (fault == 0 and found.truncated[w]):
                reason = reason | TRUNCATED
        if keep_reason:
            reason = reason | out.done_reason[w]
        out.done_reason[w] = reason
        out.terminated[w] = (reason & TERMINATED) != 0
        out.truncated[w] = (reason & ~TERMINATED) != 0
        out.done[w] = reason != 0
        if transition:
            # without automatic resets, a world continues after its episode's end, but not after a fault
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
        valid_out: wp.array2d[bool],
        obs_out: Observations,
        parts: int,
        first: int,
    ):
        """Observe each world whose mask is set, and mark valid observation groups; launched over (parts, nworld).

        If ``parts`` is 1, this kernel also replaces observations that are not valid. Otherwise,
        ``replace_observations`` must be launched next.
        """
        start, k = wp.tid()
        w = first + k
        if mask_in[w]:
            valid = bool(True)
            for group in range(start, valid_out.shape[0], parts):
                observe(group, view(batch, w), params[w % params.shape[0]], obs_out, w, counters)
                valid_out[group, w] = valid_group(group, obs_out, w)
                valid = valid and valid_out[group, w]
            if parts == 1 and not valid:
                copy_observations(good_in, obs_out, w, 0, 1)

    @task.kernel()
    def replace_observations(
        mask_in: wp.array[bool],
        valid_in: wp.array2d[bool],
        good_in: Observations,
        obs_inout: Observations,
        lanes: int,
        first: int,
    ):
        """Replace observations that are not valid by the last good ones; launched over (nworld, lanes).

        The next step reports the fault.
        """
        k, lane = wp.tid()
        w = first + k
        if mask_in[w]:
            valid = bool(True)
            for group in range(valid_in.shape[0]):
                valid = valid and valid_in[group, w]
            if not valid:
                copy_observations(good_in, obs_inout, w, lane, lanes)


def rollout_kernels(task: TaskCode) -> None:
    """Make the kernels for open-loop rollouts, which store the fields of all steps.

    Row t * nworld + w is world w after t steps. ``before`` and ``after`` are views of the same arrays, but ``after``
    starts at row nworld, and thus holds the next states.
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
