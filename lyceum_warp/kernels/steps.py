"""The kernels of one step, around the functions of a task."""

from collections.abc import Collection, Mapping
from types import SimpleNamespace

import warp as wp

from lyceum_warp.done import Done
from lyceum_warp.kernels import faults
from lyceum_warp.kernels.random import stream

TERMINATED = wp.constant(int(Done.TERMINATED))
TRUNCATED = wp.constant(int(Done.TRUNCATED))
ACTION = wp.constant(int(Done.ACTION))


@wp.struct
class Outcome:
    """The outcome of a step in each world; every array is (nworld,), observations are (nworld, nobs)."""

    reward: wp.array[float]
    eval: wp.array[float]
    terminated: wp.array[bool]
    truncated: wp.array[bool]
    success: wp.array[bool]
    done: wp.array[bool]
    done_reason: wp.array[int]
    obs: wp.array2d[float]
    final_obs: wp.array2d[float]


OUTCOMES = {
    "reward": wp.float32,
    "eval": wp.float32,
    "terminated": wp.bool,
    "truncated": wp.bool,
    "success": wp.bool,
    "done": wp.bool,
    "done_reason": wp.int32,
    "obs": wp.float32,
    "final_obs": wp.float32,
}
"""The fields of Outcome and the types of their elements."""


@wp.kernel(enable_backward=False)
def count_faults(fault_in: wp.array[int], count_out: wp.array[int]):
    """Count each kind of fault, at the place of its bit in Done; launched over (nworld,)."""
    w = wp.tid()
    fault = fault_in[w]
    if fault != 0:
        for bit in range(count_out.shape[0]):
            if ((fault >> bit) & 1) != 0:
                wp.atomic_add(count_out, bit, 1)


def make_kernels(
    Batch,  # noqa: N803
    view,
    Params,  # noqa: N803
    functions: Mapping[str, wp.Function],
    written: Collection[str],
    *,
    module: str,
) -> SimpleNamespace:
    """Fuse a task's functions into the kernels of a step.

    Args:
        Batch: Struct of the task's fields for all worlds.
        view: Function from (batch, world) to the struct that the task's functions take.
        Params: Struct of the task's parameters; an array of them holds one entry, or one a world.
        functions: The task's functions by name, with defaults for those that it does not have.
        written: Names of the functions that the task has. Without ``control`` a scale and an offset map actions to
            controls; without ``evaluate`` the evaluation is the reward; without ``advance`` memory stays as it is.
        module: Name of the Warp module that the kernels are compiled into, one for each task.
    """
    observe, control, reward = functions["observe"], functions["control"], functions["reward"]
    evaluate, terminated, success = functions["evaluate"], functions["terminated"], functions["success"]
    initialize, randomize, advance = functions["initialize"], functions["randomize"], functions["advance"]
    has_control, has_evaluate, has_advance = (name in written for name in ("control", "evaluate", "advance"))

    @wp.kernel(module=module, enable_backward=False)
    def act(
        batch: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
        range_in: wp.array2d[float],
        scale_in: wp.array2d[float],
        step_inout: wp.array[int],
        safe_action_out: wp.array2d[float],
        fault_out: wp.array[int],
        ctrl_out: wp.array2d[float],
    ):
        """Map actions to controls, clipped to their ranges; launched over (nworld,).

        An action that is not finite counts as zero.
        """
        w = wp.tid()
        fault = int(0)
        for i in range(action_in.shape[1]):
            if not wp.isfinite(action_in[w, i]):
                fault = ACTION
        fault_out[w] = fault
        for i in range(action_in.shape[1]):
            safe_action_out[w, i] = wp.where(fault == 0, action_in[w, i], 0.0)
        if wp.static(has_control):
            control(view(batch, w), safe_action_out[w], params[w % params.shape[0]], ctrl_out[w])
        else:
            for i in range(ctrl_out.shape[1]):
                ctrl_out[w, i] = safe_action_out[w, i] * scale_in[i, 0] + scale_in[i, 1]
        for i in range(ctrl_out.shape[1]):
            ctrl_out[w, i] = wp.clamp(ctrl_out[w, i], range_in[i, 0], range_in[i, 1])
        step_inout[w] = step_inout[w] + 1

    @wp.kernel(module=module, enable_backward=False)
    def advance_memory(
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
        step_in: wp.array[int],
        key_in: wp.array[wp.uint32],
        episode_in: wp.array[int],
        rng_inout: wp.array2d[wp.uint32],
    ):
        """Advance the task's memory by one step; launched over (nworld,)."""
        w = wp.tid()
        rng_inout[w, 0] = stream(key_in[w], episode_in[w], step_in[w])
        p = params[w % params.shape[0]]
        advance(view(before, w), action_in[w], view(after, w), p, rng_inout[w])

    @wp.kernel(module=module, enable_backward=False)
    def judge(
        mask_in: wp.array[bool],
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
        step_in: wp.array[int],
        horizon: int,
        transition: bool,
        keep_reason: bool,
        fault_inout: wp.array[int],
        action_fault_in: wp.array[int],
        out: Outcome,
        restart_out: wp.array[bool],
    ):
        """Judge a transition, or a state alone, in the masked worlds; launched over (nworld,).

        Writes the reward, the evaluation, termination, success and the observation.

        A transition with a fault has reward 0, the evaluation of the state before it, and the last good observation.
        It counts as terminated, so that no learner bootstraps from it.
        """
        w = wp.tid()
        if not mask_in[w]:
            return
        p = params[w % params.shape[0]]
        s0 = view(before, w)
        s1 = view(after, w)
        fault = fault_inout[w] | action_fault_in[w]
        fault_inout[w] = fault
        gain = float(0.0)
        if fault == 0:
            if transition:
                gain = reward(s0, action_in[w], s1, p)
            observe(s1, p, out.final_obs[w])
        else:
            for i in range(out.obs.shape[1]):
                out.final_obs[w, i] = out.obs[w, i]
        if wp.static(has_evaluate):
            if fault == 0:
                out.eval[w] = evaluate(s1, p)
            elif transition:
                last = evaluate(s0, p)
                if not faults.is_out_of_range(last):  # else keep the evaluation of an earlier state
                    out.eval[w] = last
        else:
            out.eval[w] = gain
        out.reward[w] = gain
        reason = fault
        if fault == 0:
            if terminated(s1, p):
                reason = reason | TERMINATED
            out.success[w] = success(s1, p)
        else:
            out.success[w] = False
        if horizon > 0 and step_in[w] >= horizon:
            reason = reason | TRUNCATED
        if keep_reason:
            reason = reason | out.done_reason[w]
        out.done_reason[w] = reason
        out.terminated[w] = (reason & ~TRUNCATED) != 0
        out.truncated[w] = (reason & TRUNCATED) != 0
        out.done[w] = reason != 0
        for i in range(out.obs.shape[1]):
            out.obs[w, i] = out.final_obs[w, i]
        if transition:
            # without automatic resets a world steps on after its end, but not after a fault
            restart_out[w] = wp.where(keep_reason, fault != 0, reason != 0)

    @wp.kernel(module=module, enable_backward=False)
    def restart(
        mask_in: wp.array[bool],
        random: bool,
        batch: Batch,
        params: wp.array[Params],
        key_in: wp.array[wp.uint32],
        rng_inout: wp.array2d[wp.uint32],
        step_out: wp.array[int],
        episode_inout: wp.array[int],
    ):
        """Begin an episode in the masked worlds; launched over (nworld,).

        The engine has already put them into the model's initial state.
        """
        w = wp.tid()
        if not mask_in[w]:
            return
        step_out[w] = 0
        episode = episode_inout[w] + 1
        episode_inout[w] = episode
        rng_inout[w, 0] = stream(key_in[w], episode, 0)
        p = params[w % params.shape[0]]
        s = view(batch, w)
        initialize(s, p)
        if random:
            randomize(s, p, rng_inout[w])

    @wp.kernel(module=module, enable_backward=False)
    def observe_worlds(mask_in: wp.array[bool], batch: Batch, params: wp.array[Params], obs_out: wp.array2d[float]):
        """Observe the masked worlds; launched over (nworld,)."""
        w = wp.tid()
        if mask_in[w]:
            observe(view(batch, w), params[w % params.shape[0]], obs_out[w])

    # An open-loop rollout keeps its fields for all steps: row t * nworld + w is world w after t steps. The
    # transition of that row leads to the one nworld further, so `before` and `after` are the same arrays, shifted.

    @wp.kernel(module=module, enable_backward=False)
    def judge_rows(
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
        reward_out: wp.array[float],
        terminated_out: wp.array[bool],
    ):
        """Compute reward and termination of a rollout's transitions; launched over (steps * nworld,)."""
        row = wp.tid()
        p = params[row % params.shape[0]]
        s1 = view(after, row)
        reward_out[row] = reward(view(before, row), action_in[row], s1, p)
        terminated_out[row] = terminated(s1, p)

    @wp.kernel(module=module, enable_backward=False)
    def advance_rows(
        before: Batch,
        after: Batch,
        params: wp.array[Params],
        action_in: wp.array2d[float],
        step_in: wp.array[int],
        key_in: wp.array[wp.uint32],
        episode_in: wp.array[int],
        memory_inout: wp.array2d[float],
        rng_inout: wp.array2d[wp.uint32],
    ):
        """Advance the task's memory along a rollout; launched over (nworld,), one thread for all steps of a world."""
        w = wp.tid()
        n = step_in.shape[0]
        p = params[w % params.shape[0]]
        for t in range(action_in.shape[0] // n):
            row = t * n + w
            for i in range(memory_inout.shape[1]):
                memory_inout[row + n, i] = memory_inout[row, i]
            rng_inout[w, 0] = stream(key_in[w], episode_in[w], step_in[w] + t + 1)
            advance(view(before, row), action_in[row], view(after, row), p, rng_inout[w])

    return SimpleNamespace(
        Batch=Batch,
        act=act,
        advance_memory=advance_memory if has_advance else None,
        judge=judge,
        restart=restart,
        observe_worlds=observe_worlds,
        judge_rows=judge_rows,
        advance_rows=advance_rows if has_advance else None,
    )
