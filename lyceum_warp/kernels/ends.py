"""Decide whether a world's episode ends, and why: a fault, the task's functions, or the time limit."""

import warp as wp

from lyceum_warp.core.done import Done
from lyceum_warp.kernels.step_types import Findings, Outcome

TERMINATED = wp.constant(int(Done.TERMINATED))
TRUNCATED = wp.constant(int(Done.TRUNCATED))


@wp.func
def all_faults(w: int, fault: int, findings: Findings) -> int:
    """Add the faults that the parts of ``judge`` found to those of the engine and of the action."""
    bits = int(fault)
    for part in range(findings.fault.shape[0]):
        bits = bits | findings.fault[part, w]
    return bits


@wp.func
def add_metrics(w: int, lane: int, lanes: int, valid: bool, out: Outcome, sum_inout: wp.array2d[float]):
    """Add a step's metrics to the sums of the episode; they are 0 if the step is not valid."""
    for i in range(lane, out.metrics.shape[1], lanes):
        if not valid:
            out.metrics[w, i] = 0.0
        if wp.isfinite(out.metrics[w, i]):  # the sum is part of the state, which must be finite
            sum_inout[w, i] = sum_inout[w, i] + out.metrics[w, i]
        out.episode_metrics[w, i] = sum_inout[w, i]


@wp.func
def count_success(success: bool, needed: int, count_inout: wp.array[float]):
    """Count the successful steps in a row, up to the number that an episode needs."""
    count = wp.min(count_inout[0] + 1.0, float(needed))
    count_inout[0] = wp.where(success, count, 0.0)


@wp.func
def reason_of_end(fault: int, terminated: bool, truncated: bool, step: int, horizon: int) -> int:
    """Return why a transition ends its episode, as bits of Done; a time limit of 0 steps is none."""
    reason = int(fault)
    if terminated:
        reason = TERMINATED
    if truncated or (horizon > 0 and step >= horizon):
        reason = reason | TRUNCATED
    return reason


@wp.func
def put_reason(w: int, reason: int, out: Outcome):
    out.done_reason[w] = reason
    out.terminated[w] = (reason & TERMINATED) != 0
    out.truncated[w] = (reason & ~TERMINATED) != 0
    out.done[w] = reason != 0
