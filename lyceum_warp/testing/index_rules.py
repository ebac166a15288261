"""Check that no function of a task uses an index out of range, and that results are finite."""

from lyceum_warp.core import Done
from lyceum_warp.env import Probe
from lyceum_warp.testing.context import Context

_STEPS = 100


def check_bounds(ctx: Context) -> None:
    """No function of the task reads or writes out of range in the states of random steps.

    Rewards and observations are finite, except in a state with another fault.
    """
    env = ctx.a
    for i, action in enumerate(ctx.actions(min(ctx.steps, _STEPS))):
        env.step(action)
        reasons = {Done(int(reason)) for reason in env.done_reason}
        ctx.that(reasons.isdisjoint((Done.REWARD, Done.OBSERVATION)), f"step {i} has the done reasons {reasons}")
        try:
            Probe(env.worlds, i % env.nworld).check_bounds()
        except ValueError as error:
            ctx.fail(f"{error} in step {i}", i % env.nworld)
