"""Make the kernels that compute rewards, metrics and observations, and decide whether an episode ends."""

import warp as wp

from lyceum_warp.core.done import Done
from lyceum_warp.kernels import faults
from lyceum_warp.kernels.step_types import Counters, Findings, Outcome, TaskCode

TERMINATED = wp.constant(int(Done.TERMINATED))
TRUNCATED = wp.constant(int(Done.TRUNCATED))
REWARD = wp.constant(int(Done.REWARD))
OBSERVATION = wp.constant(int(Done.OBSERVATION))
NAN = wp.constant(int(Done.NAN))

# the parts of ``judge``; from OBSERVE_FIRST on, each observation group is a part
ENDS = wp.constant(0)
GAIN = wp.constant(1)
METRICS = wp.constant(2)
OBSERVE_FIRST = wp.constant(3)


def make_check_memory(task: TaskCode) -> None:
    Batch, finite_memory = task.Batch, task.finite_memory  # noqa: N806

    @task.kernel(task.has_memory)
    def check_memory(
        mask_in: wp.array[bool], before: Batch, after: Batch, fault_inout: wp.array[int], lanes: int, first: int
    ):
        """Find faults in the task's memory, in the masked worlds; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        if mask_in[w] and not finite_memory(before, after, w, lane, lanes):
            fault_inout[w] = fault_inout[w] | NAN


def make_judge(task: TaskCode) -> None:
    Batch, Params, Observations = task.Batch, task.Params, task.Observations  # noqa: N806
    view, observe_group, valid_group = task.view, task.observe_group, task.valid_group
    terminated, truncated = task.functions["terminated"], task.functions["truncated"]
    success, evaluate = task.functions["success"], task.functions["evaluate"]
    reward, measure = task.functions["reward"], task.functions["measure"]
    has_evaluate, has_measure = "evaluate" in task.written, "measure" in task.written
    score, has_score = task.terms.get("score"), "score" in task.terms

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
                    observe_group(group, s1, p, obs_out, w, counters)
                    if not valid_group(group, obs_out, w):
                        found = OBSERVATION
            found_out.fault[part, w] = found


def make_conclude(task: TaskCode) -> None:
    Batch, Params, Observations = task.Batch, task.Params, task.Observations  # noqa: N806
    view, copy_observations = task.view, task.copy_observations
    evaluate, has_evaluate = task.functions["evaluate"], "evaluate" in task.written
    has_metrics = "measure" in task.written or "score" in task.terms

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


def make_observe_worlds(task: TaskCode) -> None:
    Batch, Params, Observations = task.Batch, task.Params, task.Observations  # noqa: N806
    view, observe_group, valid_group = task.view, task.observe_group, task.valid_group
    copy_observations = task.copy_observations

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
                observe_group(group, view(batch, w), params[w % params.shape[0]], obs_out, w, counters)
                valid_out[group, w] = valid_group(group, obs_out, w)
                valid = valid and valid_out[group, w]
            if parts == 1 and not valid:
                copy_observations(good_in, obs_out, w, 0, 1)


def make_replace_observations(task: TaskCode) -> None:
    Observations, copy_observations = task.Observations, task.copy_observations  # noqa: N806

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
