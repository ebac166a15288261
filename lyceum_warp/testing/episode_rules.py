"""Check how episodes end, and whether graphs change results."""

import torch

from lyceum_warp.core import Done
from lyceum_warp.env import Env
from lyceum_warp.testing.context import Context


def _check_flags(ctx: Context, env: Env) -> None:
    reason = env.done_reason
    ctx.equal(env.truncated, (reason & ~int(Done.TERMINATED)) != 0, "truncated against done_reason")
    ctx.equal(env.terminated, (reason & int(Done.TERMINATED)) != 0, "terminated against done_reason")
    ctx.equal(env.done, env.terminated | env.truncated, "done against terminated and truncated")


def check_truncation(ctx: Context) -> None:
    """An episode is truncated at the horizon, and earlier only by the task's ``truncated``.

    ``final_obs`` is then its last observation, and ``obs`` the first observation of the next episode.
    """
    a, b, horizon = ctx.a, ctx.b, 4
    with ctx.changed(a, horizon=horizon, autoreset=True), ctx.changed(b, horizon=horizon, autoreset=False):
        steps = torch.zeros_like(a.done_reason)
        alive = torch.ones_like(a.done)
        for action in ctx.actions(2 * horizon + 1):
            a.step(action)
            b.step(action)
            steps += 1
            _check_flags(ctx, a)
            truncated = a.truncated if not a.task.ends_by("truncated") else a.truncated & (steps >= horizon)
            ctx.equal(truncated, steps >= horizon, f"truncated after {steps.tolist()} steps of an episode")
            going, state = ~a.done & ctx.calm(a), a.get_state()
            # automatic resets change no value before a world's first episode ends
            for name in a.worlds.obs_spaces:  # without pictures, which are rendered only where an episode ends
                final = a.final_obs_groups[name]
                ctx.equal(final[alive], b.final_obs_groups[name][alive], f"the final group {name} without resets")
                ctx.equal(final[going], a.obs_groups[name][going], f"the final group {name} of worlds that go on")
            for name, obs in a.obs_groups.items():
                ctx.equal(a.get_obs(state, group=name), obs, f"get_obs of the group {name} after automatic resets")
            ctx.equal(a.reward[alive], b.reward[alive], "reward against the one without automatic resets")
            for name in ("terminated", "truncated"):
                with_resets, without = (getattr(env, name)[alive] for env in (a, b))
                ctx.equal(with_resets, without, f"{name} with and without automatic resets")
            alive &= ~a.done
            ctx.that((a.time[a.done] == 0).all(), f"time is {a.time.tolist()} where done is {a.done.tolist()}")
            count = state[:, a.state_space.parts["step"]].squeeze(1)
            steps[a.done] = 0
            ctx.equal(count, steps.to(count.dtype), "the state's step counter")


def check_graphs(ctx: Context) -> None:
    """Results are equal bit for bit with and without graphs."""
    a, b, n = ctx.a, ctx.b, 20
    with ctx.changed(a, horizon=6, graphs=True), ctx.changed(b, horizon=6, graphs=False):
        actions = ctx.actions(n)
        ctx.same_runs(ctx.run(b, actions), ctx.run(a, actions), "without graphs")
        for _ in range(3):
            a.rand_reset(ctx.seed)
            b.rand_reset(ctx.seed)
            ctx.equal(b.get_state(), a.get_state(), "the state after rand_reset without graphs")
