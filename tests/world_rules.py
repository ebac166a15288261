"""Check the worlds of a task like the rules of ``check_task``, but what neither a task nor an engine can break."""

import numpy as np
import torch
import warp as wp

from lyceum_warp.core import Done
from lyceum_warp.env import Env, memory_columns
from lyceum_warp.support.arrays import launch_worlds, torch_view
from lyceum_warp.testing import CHECKS as RULES, Context

SHORT = 8


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


def check_noise(ctx: Context) -> None:
    """Equal states give equal noise. Worlds, episodes and steps have different noise."""
    env = ctx.a
    if not env.task.noisy_groups:
        return
    env.step(ctx.actions(1)[0])
    state = env.get_state()
    ctx.equal(env.get_obs(state), env.obs, "the noise of a state")
    parts = env.state_space.parts
    # these states differ only in their random streams
    same = state[:1].expand_as(state).contiguous()
    changes: dict[str, torch.Tensor] = {"key": state[:, parts["key"]]}
    for name in ("episode", "step"):
        changes[name] = same[:, parts[name]] + torch.arange(env.nworld, device=state.device)[:, None].double()
    differ = {}
    for name, values in changes.items():
        moved = same.clone()
        moved[:, parts[name]] = values
        shown = [env.get_obs(moved, group=group) for group in env.task.noisy_groups]
        differ[name] = any(bool((obs[1:] != obs[:1]).any(dim=1).all()) for obs in shown)
    if any(differ.values()):  # a task's noise may have scale 0
        for name, found in differ.items():
            ctx.that(found, f"the noise is the same for every {'world' if name == 'key' else name}")


def check_metrics(ctx: Context) -> None:
    """``episode_metrics`` are sums of ``metrics`` over an episode without faults. They are part of the state."""
    a, b, horizon = ctx.a, ctx.b, 4
    if not a.metrics:
        return
    with ctx.changed(a, b, horizon=horizon, autoreset=True):
        sums = {name: torch.zeros_like(values) for name, values in a.metrics.items()}
        for i, action in enumerate(ctx.actions(2 * horizon + 1)):
            if i == horizon + 1:
                action[-1] = torch.nan
            a.step(action)
            for name, values in a.metrics.items():
                sums[name] += values
                ctx.equal(a.episode_metrics[name], sums[name], f"the sums of {name} at step {i}")
                ctx.that((values[ctx.faulty(a)] == 0).all(), f"{name} of a fault: {values}")
                sums[name][a.done] = 0.0
            if i == horizon + 1:
                ctx.that(ctx.faulty(a)[-1], "an action of NaN is not a fault")
        b.set_state(a.get_state())
        for name in a.metrics:
            ctx.equal(b.episode_metrics[name], sums[name], f"the sums of {name} after set_state")
        for reset in (a.reset, a.rand_reset):
            reset()
            for name, values in a.episode_metrics.items():
                ctx.that((values == 0).all(), f"the sums of {name} after {reset.__name__} are {values.tolist()}")


def check_success_steps(ctx: Context) -> None:
    """``success`` requires ``success_steps`` successes in a row.

    The number of successes so far is part of the state, and a reset clears it.
    """
    a, b, needed = ctx.a, ctx.b, int(ctx.a.task.definition.success_steps)
    if needed == 1:
        return
    column = a.state_space.parts["success_steps"]
    with ctx.changed(a, b, horizon=0, autoreset=False):
        state = a.get_state()
        state[:, column] = torch.arange(a.nworld, dtype=state.dtype, device=state.device)[:, None] % needed
        a.set_state(state)
        count = state[:, column].squeeze(1)
        ctx.equal(a.get_state(), state, "the state with another count after set_state (world, column)")
        ctx.that(not a.success.any(), f"success is {a.success.tolist()} in states with the counts {count.tolist()}")
        for i, action in enumerate(ctx.actions(SHORT + needed)):
            a.step(action)
            state = a.get_state()
            found, good = state[:, column].squeeze(1), ~ctx.faulty(a)
            full = state.clone()
            full[:, column] = float(needed)
            b.set_state(full)
            calm = ctx.calm(a) & good  # after the evaluation of the step, an event may change the state
            count = torch.where(calm & b.success, (count + 1).clamp(max=needed), 0.0)
            ctx.equal(found[calm], count[calm], f"the count of steps in a row after step {i}")
            ctx.equal(a.success[good], found[good] == needed, f"success of step {i} with the counts {found.tolist()}")
            count = found
        for reset in (a.reset, a.rand_reset):
            a.set_state(full)
            reset()
            found = a.get_state()[:, column]
            ctx.that((found == 0).all(), f"the counts after {reset.__name__} are {found.squeeze(1).tolist()}")


def check_lasting_memory(ctx: Context) -> None:
    """Resets preserve lasting memory, except for ``rand_reset(seed)``, which clears it."""
    a, b = ctx.a, ctx.b
    if (columns := memory_columns(a.task, a.state_space).get("lasting_memory")) is None:
        return
    state = a.get_state()
    state[:, columns] = 3.25
    writes = a.task.writes
    a.set_state(state)
    if "lasting_memory" not in writes.get("initialize", ()):
        a.reset()
        ctx.equal(a.get_state()[:, columns], state[:, columns], "lasting_memory after reset")
        if "lasting_memory" not in writes.get("randomize", ()):
            a.rand_reset()
            ctx.equal(a.get_state()[:, columns], state[:, columns], "lasting_memory after rand_reset")
    a.set_state(state)
    a.rand_reset(ctx.seed, ctx.mask(0))
    found, fresh = a.get_state()[:, columns], b.get_state()[:, columns]
    ctx.equal(found[:1], fresh[:1], "lasting_memory after rand_reset with a seed")
    ctx.equal(found[1:], state[1:, columns], "lasting_memory of other worlds")


def check_rejection(ctx: Context) -> None:
    """Each world draws initial states until one is accepted, up to the maximum number of draws."""
    a, b = ctx.a, ctx.b
    reject = a.task.kernels.reject_worlds
    if reject is None:
        return
    task, engine = a.task.definition, a.engine
    count, rejected = torch.zeros(a.nworld, dtype=torch.int), wp.zeros(a.nworld, dtype=bool, device=a.device)
    reset = engine.reset

    def counted(mask: wp.array) -> None:
        count.add_(torch.from_numpy(mask.numpy().astype(np.int32)))
        reset(mask)

    with ctx.changed(a, graphs=False):
        for i in range(6):
            state = a.get_state()
            count.zero_()
            engine.reset = counted  # type: ignore[method-assign]
            try:
                a.rand_reset()
            finally:
                del engine.reset
            ctx.that((count >= 1).all() and (count <= task.draws).all(), f"reset {i} took {count.tolist()} draws")
            if not task.settle:
                args = [a.worlds.everyone, a.worlds.after, a.worlds.params, rejected]
                launch_worlds(reject, a.nworld, args, a.device)
                bad = torch_view(rejected).cpu() & (count < task.draws)
                ctx.that(not bad.any(), f"reset {i} kept a rejected state after {count.tolist()} draws")
            alone = ctx.mask(i % a.nworld)
            b.set_state(state)
            b.rand_reset(mask=alone)
            ctx.equal(b.get_state()[alone], a.get_state()[alone], f"the state of world {i % a.nworld}, reset alone")


CHECKS = (
    *RULES,
    check_truncation,
    check_noise,
    check_metrics,
    check_success_steps,
    check_lasting_memory,
    check_rejection,
)
"""The rules of ``check_task``, and those of this module."""
