"""Make the kernels that compute rewards, metrics and observations, and end episodes."""

import warp as wp

from lyceum_warp.core.done import Done
from lyceum_warp.kernels import ends, faults
from lyceum_warp.kernels.step_types import Episodes, Findings, Outcome, TaskCode

REWARD = wp.constant(int(Done.REWARD))
OBSERVATION = wp.constant(int(Done.OBSERVATION))
NAN = wp.constant(int(Done.NAN))

# the parts of ``judge``; from OBSERVE_FIRST on, each observation group is a part
ENDS = wp.constant(0)
GAIN = wp.constant(1)
METRICS = wp.constant(2)
OBSERVE_FIRST = wp.constant(3)


def make_transition_kernels(task: TaskCode) -> None:
    _make_check_memory(task)
    _make_judge(task)
    _make_conclude(task)
    _make_observe_worlds(task)
    _make_replace_observations(task)


def _make_check_memory(task: TaskCode) -> None:
    @task.kernel(task.finite_memory is not None)
    def check_memory(mask_in: wp.array[bool], t: task.Transition, fault_inout: wp.array[int], lanes: int, first: int):
        """Find faults in the task's memory, in the masked worlds; launched over (nworld, lanes)."""
        k, lane = wp.tid()
        w = first + k
        if mask_in[w] and not task.finite_memory(t.before, t.after, w, lane, lanes):
            fault_inout[w] = fault_inout[w] | NAN


def _make_judge(task: TaskCode) -> None:
    @task.kernel()
    def judge(
        mask_in: wp.array[bool],
        t: task.Transition,
        transition: bool,
        fault_in: wp.array[int],
        action_fault_in: wp.array[int],
        findings_out: Findings,
        metrics_out: wp.array2d[float],
        obs_out: task.Observations,
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
        for part in range(start, findings_out.fault.shape[0], threads):
            fault = int(0)
            if (fault_in[w] | action_fault_in[w]) == 0:
                s1, p = task.view(t.after, w), task.params_of(t, w)
                if part == ENDS:
                    findings_out.terminated[w] = task.functions.terminated(s1, p)
                    findings_out.truncated[w] = task.functions.truncated(s1, p)
                    findings_out.success[w] = task.functions.success(s1, p)
                    if wp.static("evaluate" in task.written):
                        findings_out.eval[w] = task.functions.evaluate(s1, p)
                elif part == GAIN:
                    if wp.static(hasattr(task.terms, "score")):
                        for i in range(metrics_out.shape[1]):
                            metrics_out[w, i] = 0.0
                    if transition:
                        s0 = task.view(t.before, w)
                        if wp.static(hasattr(task.terms, "score")):
                            weights = t.weights[w % t.weights.shape[0]]
                            findings_out.reward[w] = task.terms.score(s0, t.action[w], s1, p, weights, metrics_out[w])
                        else:
                            findings_out.reward[w] = task.functions.reward(s0, t.action[w], s1, p)
                        if faults.is_out_of_range(findings_out.reward[w]):
                            fault = REWARD
                elif part == METRICS:
                    if wp.static("measure" in task.written and not hasattr(task.terms, "score")):
                        for i in range(metrics_out.shape[1]):
                            metrics_out[w, i] = 0.0
                        if transition:
                            task.functions.measure(task.view(t.before, w), t.action[w], s1, p, metrics_out[w])
                else:
                    group = part - OBSERVE_FIRST
                    if not task.observe_group(group, s1, p, obs_out, w, t.counters):
                        fault = OBSERVATION
            findings_out.fault[part, w] = fault


def _make_conclude(task: TaskCode) -> None:
    has_metrics = "measure" in task.written or hasattr(task.terms, "score")

    @task.kernel()
    def conclude(
        mask_in: wp.array[bool],
        t: task.Transition,
        findings: Findings,
        out: Outcome,
        episodes: Episodes,
        transition: bool,
        keep_reason: bool,
        fault_inout: wp.array[int],
        action_fault_in: wp.array[int],
        obs_out: task.Observations,
        final_obs_inout: task.Observations,
        lanes: int,
        first: int,
    ):
        """Combine the results of ``judge`` in the masked worlds; launched over (nworld, lanes).

        The kernel writes the reward, the metrics and their sums, the evaluation, the end of the episode, success and
        the observations. A transition with a fault has reward 0, metrics 0, the evaluation of the state before it, and
        the last good observations. Such a transition counts as truncated, so that learners bootstrap from the
        last good observations. The evaluation of a state alone does not change the count of successful steps.

        If ``transition`` is not set, the kernel evaluates a state and ends no episode. ``findings.terminated`` then
        holds the result of the task's ``terminated``. ``keep_reason`` keeps the done reasons that are already stored.
        """
        k, lane = wp.tid()
        w = first + k
        if not mask_in[w]:
            return
        fault = ends.all_faults(w, fault_inout[w] | action_fault_in[w], findings)
        if fault == 0:
            task.copy_observations(final_obs_inout, obs_out, w, lane, lanes)
        else:
            task.copy_observations(obs_out, final_obs_inout, w, lane, lanes)
        if wp.static(has_metrics):
            ends.add_metrics(w, lane, lanes, fault == 0 and transition, out, episodes.metric_sum)
        if lane > 0:
            return
        fault_inout[w] = fault
        out.reward[w] = wp.where(fault == 0 and transition, findings.reward[w], 0.0)
        if wp.static("evaluate" in task.written):
            if fault == 0:
                out.eval[w] = findings.eval[w]
            elif transition:
                findings.eval[w] = task.functions.evaluate(task.view(t.before, w), task.params_of(t, w))
                if not faults.is_out_of_range(findings.eval[w]):  # else keep the previous evaluation
                    out.eval[w] = findings.eval[w]
        else:
            out.eval[w] = out.reward[w]
        findings.terminated[w] = fault == 0 and findings.terminated[w]
        out.success[w] = fault == 0 and findings.success[w]
        if episodes.success_steps > 1:
            if transition:
                ends.count_success(out.success[w], episodes.success_steps, episodes.success_count[w])
            out.success[w] = out.success[w] and episodes.success_count[w, 0] >= float(episodes.success_steps)
        reason = int(0)
        if transition:
            truncated = fault == 0 and findings.truncated[w]
            reason = ends.reason_of_end(fault, findings.terminated[w], truncated, t.counters.step[w], episodes.horizon)
        if keep_reason:
            reason = reason | out.done_reason[w]
        ends.put_reason(w, reason, out)
        if transition:
            # without automatic resets, a world continues after its episode's end, but not after a fault
            episodes.restart[w] = wp.where(keep_reason, fault != 0, reason != 0)
            if fault != 0:
                faults.count_faults(fault, episodes.fault_count[w])


def _make_observe_worlds(task: TaskCode) -> None:
    @task.kernel()
    def observe_worlds(
        mask_in: wp.array[bool],
        t: task.Transition,
        good_in: task.Observations,
        valid_out: wp.array2d[bool],
        obs_out: task.Observations,
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
                s, p = task.view(t.after, w), task.params_of(t, w)
                valid_out[group, w] = task.observe_group(group, s, p, obs_out, w, t.counters)
                valid = valid and valid_out[group, w]
            if parts == 1 and not valid:
                task.copy_observations(good_in, obs_out, w, 0, 1)


def _make_replace_observations(task: TaskCode) -> None:
    @task.kernel()
    def replace_observations(
        mask_in: wp.array[bool],
        valid_in: wp.array2d[bool],
        good_in: task.Observations,
        obs_inout: task.Observations,
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
                task.copy_observations(good_in, obs_inout, w, lane, lanes)
