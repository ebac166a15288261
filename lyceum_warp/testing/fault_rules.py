"""Check that a fault ends its world's episode and changes no other world."""

import numpy as np
import torch

from lyceum_warp.core import Done
from lyceum_warp.testing.context import SHORT, Context


def _check_fault(ctx: Context, part: str, value: float) -> None:
    a, b, bad = ctx.a, ctx.b, ctx.a.nworld // 2
    what, reason = f"{value} in {part}", Done.ACTION if part == "action" else Done.NAN
    ctx.restart()
    others = ~ctx.mask(bad)
    for action in ctx.actions(5):
        a.step(action)
        b.step(action)
    good = {name: a.obs_groups[name][bad].clone() for name in a.worlds.obs_spaces}
    counts, actions = a.fault_counts, ctx.actions(SHORT, 1)
    for env in (a, b):
        env.action.copy_(actions[0])
    if part == "action":
        a.action[bad, 0] = value
    else:
        state = a.get_state()
        state[bad, a.state_space.parts[part].start] = value
        a.set_state(state, ctx.mask(bad), check=False)
    a.step()
    b.step()
    reasons = Done(int(a.done_reason[bad]))
    ctx.that(reason in reasons, f"{what}: done_reason is {reasons!r}")
    ended = a.truncated[bad] and a.done[bad] and not a.terminated[bad]
    ctx.that(ended, f"{what}: truncated is {a.truncated.tolist()}, terminated {a.terminated.tolist()}")
    ctx.that(a.reward[bad] == 0, f"{what}: the reward is {a.reward[bad].item()}")
    ctx.that(not a.success[bad], f"{what}: it counts as a success")
    ctx.that(torch.isfinite(a.eval[bad]), f"{what}: eval is {a.eval[bad].item()}")
    for name, obs in good.items():
        final = a.final_obs_groups[name][bad]
        ctx.equal(final, obs, f"{what}: the final group {name} against the last good observation")
    ctx.that(a.time[bad] == 0, f"{what}: the world was not reset, its time is {a.time[bad].item()}")
    name = str(reason.name).lower()
    ctx.that(a.fault_counts[name] == counts[name] + 1, f"{what}: counted {counts} before, {a.fault_counts} after")
    ctx.finite(a, f"after {what}")
    again = diverges = False
    for i, action in enumerate(actions[1:]):
        ctx.same_worlds(others, f"other worlds, {what}, step {i}")
        a.step(action)
        b.step(action)
        ctx.finite(a, f"{i + 1} steps after {what}")
        again = again or bool(ctx.faulty(a)[bad])
        diverges = diverges or bool(ctx.faulty(b)[bad])  # the task may be unstable even without the fault
    ctx.that(not again or diverges, f"{what}: the world has another fault")


def check_bad_state(ctx: Context) -> None:
    """A state with NaN or a magnitude above 1e10 ends its world's episode, and changes no other world.

    The final observation of every group is then the last valid one.
    """
    for part, value in (("qpos", np.nan), ("qvel", np.nan), ("qvel", np.inf), ("qpos", 1e11), ("qvel", -1e11)):
        _check_fault(ctx, part, value)


def check_bad_action(ctx: Context) -> None:
    """An action that is not finite counts as zero, ends its world's episode and changes no other world."""
    for value in (np.nan, np.inf, -np.inf):
        _check_fault(ctx, "action", value)


def check_bad_warmstart(ctx: Context) -> None:
    """A warm start with NaN changes no other world, and a reset clears it."""
    a, b, bad = ctx.a, ctx.b, 0
    if "qacc_warmstart" not in a.state_space.parts:
        return
    diverges = False
    state = a.get_state()
    state[bad, a.state_space.parts["qacc_warmstart"]] = np.nan
    a.set_state(state, check=False)
    for i, action in enumerate(ctx.actions(4)):
        a.step(action)
        b.step(action)
        if i == 0 and not ctx.faulty(a)[bad]:
            # the solver reads its warm start only if there are contacts
            ctx.that(torch.isfinite(a.obs[bad]).all(), "the observation is not finite, but there is no fault")
        diverges = diverges or bool(ctx.faulty(b)[bad])
        ctx.that(i == 0 or diverges or not ctx.faulty(a)[bad], f"the world has another fault at step {i}")
        ctx.same_worlds(~ctx.mask(bad), f"other worlds at step {i}")
    ctx.finite(a, "after a warm start of NaN")


def check_not_finite(ctx: Context) -> None:
    """A reward or an observation that is not finite or too large is a fault, and changes no other world.

    Each parameter becomes infinite in one world, and 1e30 in another.
    """
    a, b, extremes = ctx.a, ctx.b, {ctx.a.nworld // 2: np.inf, 0: 1e30}
    others, actions = ~ctx.mask(*extremes), ctx.actions(2)
    params = {name: value for name, value in a.task.params.items() if name not in ("dt", "substep_dt")}
    names = [name for name, value in params.items() if isinstance(value, float) and np.isfinite(value)]
    with ctx.changed(a, b, graphs=False):  # graphs would be captured again for each of these parameters
        for name in names:
            nominal = a.task.params[name]
            ctx.restart()
            a.set_params(**{name: np.array([extremes.get(world, nominal) for world in range(a.nworld)])})
            try:
                for i, action in enumerate(actions):
                    good = a.obs.clone()
                    a.step(action)
                    b.step(action)
                    for bad, value in extremes.items():
                        what = f"with {name}={value:g} in world {bad}, step {i}"
                        if int(a.done_reason[bad]) & int(Done.REWARD | Done.OBSERVATION):
                            ctx.that(a.truncated[bad] and a.reward[bad] == 0, f"the reward is {a.reward[bad]} {what}")
                            ctx.equal(a.final_obs[bad], good[bad], f"final_obs against the last good one {what}")
                            ctx.that(a.time[bad] == 0, f"the world was not reset {what}")
                        for key in ("reward", "obs", "final_obs"):
                            extreme = getattr(a, key)[bad].abs().max()
                            ctx.that(extreme < 1e10, f"{key} is {extreme} {what}")
                    ctx.same_worlds(others, f"other worlds with extreme {name}, step {i}")
            finally:
                a.set_params(**{name: nominal})
