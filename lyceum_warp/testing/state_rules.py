"""Check the state, resets, randomness and graphs."""

import numpy as np
import torch

from lyceum_warp.core import COUNTERS, FAULTS
from lyceum_warp.env import Env
from lyceum_warp.testing.context import OUTCOMES, SHORT, Context


def check_addresses(ctx: Context) -> None:
    """Buffers keep their addresses through steps, resets and ``set_state``."""
    env = ctx.a
    names = (*OUTCOMES, "action", "time")
    before = {name: (id(getattr(env, name)), getattr(env, name).data_ptr()) for name in names}
    fields = {name: array.ptr for name, array in env.engine.arrays.items()}
    state = env.get_state()
    for action in ctx.actions(SHORT):
        env.step(action)
    env.reset()
    env.rand_reset()
    env.set_state(state)
    for name in names:
        ctx.that(id(getattr(env, name)) == before[name][0], f"env.{name} is another object than before")
        ctx.that(getattr(env, name).data_ptr() == before[name][1], f"env.{name} has moved")
    for name, pointer in fields.items():
        ctx.that(env.engine.arrays[name].ptr == pointer, f"the field {name} has moved")


def check_restoring(ctx: Context) -> None:
    """Steps after ``set_state`` repeat the original steps, even through automatic resets and in another environment."""
    a, b = ctx.a, ctx.b
    with ctx.changed(a, b, horizon=6):
        ctx.run(a, ctx.actions(7))
        state, actions = a.get_state(), ctx.actions(2 * SHORT, 1)
        first = ctx.run(a, actions)
        a.set_state(state)
        ctx.same_runs(ctx.run(a, actions), first, "after restoring")
        b.rand_reset(ctx.seed + 5)
        ctx.run(b, ctx.actions(3, 2))
        b.set_state(state)
        ctx.same_runs(ctx.run(b, actions), first, "after restoring in another environment")


def check_masked_restoring(ctx: Context) -> None:
    """With a mask, ``set_state`` does not change other worlds."""
    a, b = ctx.a, ctx.b
    mask = ctx.mask()
    state, early, late = a.get_state(), ctx.actions(SHORT), ctx.actions(SHORT, 1)
    first = ctx.run(a, early)
    ctx.run(b, early)
    before = ctx.buffers(a)
    a.set_state(state, mask)
    for name, values in ctx.buffers(a).items():
        ctx.equal(values[~mask], before[name][~mask], f"{name} of worlds outside the mask (world, ...)")
    ctx.equal(a.get_state()[mask], state[mask], "the state of masked worlds")
    second = ctx.run(a, torch.where(mask[None, :, None], early, late))
    undisturbed = ctx.run(b, torch.where(mask[None, :, None], early, late))
    for name in second:
        ctx.equal(second[name][:, mask], first[name][:, mask], f"{name} of the restored worlds")
        ctx.equal(second[name][:, ~mask], undisturbed[name][:, ~mask], f"{name} of the other worlds")


def check_set_state_shows(ctx: Context) -> None:
    """After ``set_state``, every getter returns values of the new state."""
    a, b = ctx.a, ctx.b
    has_evaluate = a.task.functions["evaluate"] is not None
    with ctx.changed(a, b, autoreset=False, horizon=0):
        ended = torch.zeros_like(a.done)
        for action in ctx.actions(10):
            a.step(action)
            state, shown, calm = a.get_state(), ctx.buffers(a), ctx.calm(a)
            b.set_state(state)
            buffers = ctx.buffers(b)
            for name in shown:
                if name in ("obs", "time", "state") or name.startswith("field "):
                    ctx.equal(buffers[name], shown[name], f"{name} after set_state")
            ctx.equal(b.final_obs, a.obs, "final_obs after set_state")
            ctx.equal(b.success[calm], a.success[calm], "success after set_state")
            if has_evaluate:
                ctx.equal(b.eval[calm], a.eval[calm], "eval after set_state")
            ctx.that((b.reward == 0).all(), f"the reward after set_state is {b.reward.tolist()}")
            for name in ("terminated", "done", "done_reason"):  # the end of the episode is part of the state
                ctx.equal(getattr(b, name)[calm], getattr(a, name)[calm], f"{name} after set_state")
            judged = calm & ~ctx.faulty(a)  # a world with a fault has already restarted
            ended |= a.get_terminated(state) & judged
            ctx.equal(ended[judged], a.terminated[judged], "get_terminated of all states up to this one")


def check_purity(ctx: Context) -> None:
    """Given earlier states and actions, getters return the results of the original step, without side effects."""
    env = ctx.a
    has_evaluate = env.task.functions["evaluate"] is not None
    with ctx.changed(env, autoreset=False, horizon=0):
        actions = ctx.actions(6)
        states = [env.get_state()]
        live = ctx.run(env, actions)
        states += list(live["state"])
        ended = torch.zeros_like(env.done)
        for pause in range(2):
            for i, action in enumerate(actions):
                before = ctx.buffers(env)
                # skip worlds that an event has changed: their rewards belong to the states before the event
                calm = live["calm"][: i + 1].all(dim=0)
                fine = ((live["done_reason"][i] & int(FAULTS)) == 0) & calm
                reward = env.get_reward(states[i], action, states[i + 1])
                ctx.equal(reward[fine], live["reward"][i][fine], f"get_reward of step {i}, {20 * pause} steps later")
                state = states[i + 1]
                ctx.equal(env.get_obs(state), live["obs"][i], f"get_obs of step {i}")
                if has_evaluate:
                    ctx.equal(env.get_eval(state)[fine], live["eval"][i][fine], f"get_eval of step {i}")
                ended = env.get_terminated(state) | (ended if i else torch.zeros_like(ended))
                ctx.equal(ended[fine], live["terminated"][i][fine], f"get_terminated up to step {i}")
                for name, values in ctx.buffers(env).items():
                    ctx.equal(values, before[name], f"{name} of the live worlds after a getter with old states")
            ctx.run(env, ctx.actions(20, 1))


def check_determinism(ctx: Context) -> None:
    """Two environments with the same options and actions stay equal bit for bit through all resets."""
    for i, action in enumerate(ctx.actions(ctx.steps)):
        ctx.a.step(action)
        ctx.b.step(action)
        for name in ("reward", "eval", "done_reason", "obs", "final_obs"):
            ctx.equal(getattr(ctx.b, name), getattr(ctx.a, name), f"{name} at step {i}")
        if i % 10 == 0 or i == ctx.steps - 1:
            ctx.equal(ctx.b.get_state(), ctx.a.get_state(), f"the state at step {i}")
    ctx.finite(ctx.a, f"after {ctx.steps} random steps")


def _physics(env: Env, state: torch.Tensor) -> torch.Tensor:
    """Select the parts of an initial state that do not depend on earlier episodes."""
    names = [n for n in env.state_space.parts if n not in (*COUNTERS, *env.task.layouts.memory["lasting_memory"])]
    return torch.cat([state[:, env.state_space.parts[name]] for name in names], dim=1)


def _lasting_columns(env: Env) -> list[slice]:
    """Return the state columns of ``lasting_memory`` and of model fields that no reset randomizes."""
    names = [field.name for field in env.task.dynamics if field.name not in env.task.reset_dynamics]
    parts = env.state_space.parts
    return [parts[name] for name in (*env.task.layouts.memory["lasting_memory"], *names)]


def check_reset(ctx: Context) -> None:
    """With zero actions, ``reset`` leads to the same state regardless of the past.

    Some columns of the state survive a reset, and others may depend on them. The check first makes these columns equal
    in all worlds.
    """
    env = ctx.a
    lasting = _lasting_columns(env)
    first = env.get_state()[:1]

    def reset() -> None:
        if lasting:
            state = env.get_state()
            for columns in lasting:
                state[:, columns] = first[:, columns]
            env.set_state(state)
        env.reset()

    reset()
    state, obs = _physics(env, env.get_state()), env.obs.clone()
    noisy = bool(env.task.noisy_groups)
    if not noisy and not env.task.parameters.per_world:
        ctx.equal(obs, obs[:1].expand_as(obs).contiguous(), "the worlds' observations after reset")
    for action in ctx.actions(100):
        env.step(action)
    reset()
    ctx.equal(_physics(env, env.get_state()), state, "the state after reset, without its counters")
    if not noisy:
        ctx.equal(env.obs, obs, "obs after reset")
    obs = env.obs.clone()
    ctx.equal(env.final_obs, obs, "final_obs after reset")
    ctx.that((env.action == 0).all(), f"the actions after reset are {env.action.tolist()}")
    ctx.that((env.reward == 0).all(), f"the rewards after reset are {env.reward.tolist()}")
    ctx.equal(env.get_obs(env.get_state()), obs, "get_obs of the state after reset")


def check_masked_reset(ctx: Context) -> None:
    """With a mask, resets do not change other worlds."""
    env = ctx.a
    mask = ~ctx.mask()
    for reset in (env.reset, env.rand_reset):
        ctx.restart()
        ctx.run(env, ctx.actions(SHORT))
        before = ctx.buffers(env)
        reset(mask=mask)
        for name, values in ctx.buffers(env).items():
            ctx.equal(values[~mask], before[name][~mask], f"{name} of the worlds outside the mask of {reset.__name__}")
        started = (env.time[mask] == 0).all() and (env.action[mask] == 0).all()
        ctx.that(started, f"{reset.__name__} skipped a world")


def check_rand_reset(ctx: Context) -> None:
    """``rand_reset(seed)`` is reproducible and clears actions. Other resets, worlds and seeds give different states."""
    a, b = ctx.a, ctx.b
    ctx.run(a, ctx.actions(5))
    ctx.restart()
    state = a.get_state()
    ctx.equal(b.get_state(), state, "the state after rand_reset with the same seed")
    ctx.equal(b.obs, a.obs, "obs after rand_reset with the same seed")
    ctx.that((a.action == 0).all(), f"the actions after rand_reset are {a.action.tolist()}")
    a.rand_reset()
    second = a.get_state()
    b.rand_reset()
    ctx.equal(b.get_state(), second, "the second draw")
    a.rand_reset(ctx.seed + 1)
    other = a.get_state()
    if a.task.functions["randomize"] is not None:
        first = _physics(a, state)
        ctx.that((_physics(a, second) != first).any(dim=1).all(), "two consecutive draws are the same")
        ctx.that((_physics(a, other) != first).any(dim=1).all(), "two seeds give the same worlds")
        if a.nworld > 1:
            ctx.that((first[1:] != first[:1]).any(dim=1).all(), "worlds of one draw are the same")
    a.rand_reset(ctx.seed)
    ctx.equal(a.get_state(), state, "the state after rand_reset with the first seed again")


def check_world_count(ctx: Context) -> None:
    """The initial state of a world depends on its seed, and not on the number of worlds."""
    n = ctx.a.nworld
    doubled = {name: np.concatenate([v, v]) for name, v in ctx.a.task.parameters.per_world.items()}
    more = ctx.make(nworld=2 * n, seed=ctx.seed, **doubled)
    ctx.equal(more.get_state()[:n], ctx.a.get_state(), f"the states of {n} of {2 * n} worlds")
    ctx.equal(more.obs[:n], ctx.a.obs, f"the observations of {n} of {2 * n} worlds")


def check_keyframe(ctx: Context) -> None:
    """A reset starts from the task's keyframe."""
    env = ctx.a
    if (name := env.task.definition.keyframe) is None:
        return
    key = env.task.model.key(name)
    env.engine.reset(env.worlds.everyone)
    state = env.get_state()
    env.rand_reset(ctx.seed)
    parts = {"qpos": key.qpos, "qvel": key.qvel, "act": key.act, "ctrl": key.ctrl, "mocap_pos": key.mpos}
    for part, values in parts.items():
        if part in env.state_space.parts:
            wanted = torch.as_tensor(np.asarray(values).ravel().astype(np.float32), device=state.device).double()
            rows = state[:, env.state_space.parts[part]]
            ctx.equal(rows.float(), wanted.float().expand_as(rows).contiguous(), f"{part} of the keyframe {name!r}")


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
