"""Check how episodes end, whether graphs change results, and whether steps leak memory."""

import gc
import tracemalloc

import torch
import warp as wp

from lyceum_warp.core import Done
from lyceum_warp.env import Env
from lyceum_warp.testing.context import Context

# the interpreter's caches may grow by this much; one leaked float per step is 3,200 bytes after 100 steps
_PYTHON_BYTES = 2_048


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
            for name, obs in a.obs_groups.items():
                final = a.final_obs_groups[name]
                ctx.equal(final[alive], b.final_obs_groups[name][alive], f"the final group {name} without resets")
                ctx.equal(final[going], obs[going], f"the final group {name} of worlds that go on")
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


def check_no_autoreset(ctx: Context) -> None:
    """Without automatic resets, a finished world keeps stepping with ``done`` set, and ``final_obs`` equals ``obs``."""
    env, horizon = ctx.a, 3
    with ctx.changed(env, horizon=horizon, autoreset=False):
        ended = torch.zeros_like(env.done)
        for i, action in enumerate(ctx.actions(3 * horizon), 1):
            env.step(action)
            _check_flags(ctx, env)
            ctx.that((env.done | ~ended).all(), f"done was {ended.tolist()} and is {env.done.tolist()}")
            ended |= env.done
            ctx.that(i < horizon or env.truncated.all(), f"truncated is {env.truncated.tolist()} after {i} steps")
            if not ctx.faulty(env).any():
                ctx.that((env.time > (i - 0.5) * env.timestep).all(), f"time is {env.time.tolist()} after {i} steps")
                calm = ctx.calm(env)
                ctx.equal(env.final_obs[calm], env.obs[calm], "final_obs without automatic resets")
        env.rand_reset(mask=ctx.mask(0))
        ctx.that(not env.truncated[0] and env.truncated[1:].all(), "a masked reset cleared other ends")


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


def _memory(device: wp.Device) -> dict[str, int]:
    gc.collect()
    found = {"Python bytes": tracemalloc.get_traced_memory()[0]}
    # isinstance would load lazy modules
    found["arrays"] = sum(issubclass(type(thing), (wp.array, torch.Tensor)) for thing in gc.get_objects())
    if device.is_cuda:
        found["Warp bytes"] = wp.get_mempool_used_mem_current(device)
        found["torch bytes"] = torch.cuda.memory_allocated(wp.device_to_torch(device))
    return found


def check_memory(ctx: Context) -> None:
    """Steps, resets, ``get_state`` and ``set_state`` leak no memory."""
    env = ctx.a
    actions, state = ctx.actions(32), env.get_state()
    mask = ctx.mask()

    def steps(n: int) -> None:
        for i in range(n):
            env.step(actions[i % 32])
            if i % 16 == 0:
                env.get_state(out=state)
                env.rand_reset(mask=mask)
                env.set_state(state, mask)
                env.reset(mask)

    steps(64)
    tracing = tracemalloc.is_tracing()
    if not tracing:
        tracemalloc.start()
    try:
        steps(64)
        before = _memory(env.device)
        steps(ctx.steps)
        after = _memory(env.device)
    finally:
        if not tracing:
            tracemalloc.stop()
    for name in before:
        allowed = _PYTHON_BYTES if name == "Python bytes" else 0
        growth = after[name] - before[name]
        ctx.that(growth <= allowed, f"{growth} more {name} after {ctx.steps} steps")
