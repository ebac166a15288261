"""Check that inputs (such as applied forces), model fields and ``settle`` affect a world's physics.

The engine's result must be closer to ``mj_step`` with these inputs and fields than to ``mj_step`` without them.
"""

import copy
import dataclasses

import mujoco
import numpy as np
import torch

from lyceum_warp.core import INPUTS
from lyceum_warp.env import Env, memory_columns
from lyceum_warp.support.arrays import flat, torch_view
from lyceum_warp.testing.context import SHORT, Context

_SMALLEST = 1e-4
"""Inputs and model fields are not checked if they move all coordinates by less than this distance."""


def converged(ctx: Context) -> Context:
    """Let the solver of ``ctx.a`` converge, because engines that stop it early differ from ``mj_step``."""
    if ctx.a.task.model.opt.iterations >= 20:
        return ctx
    ctx = dataclasses.replace(ctx, a=ctx.make(solver={"iterations": 20, "ls_iterations": 50}))
    ctx.restart()
    return ctx


def predicted(
    env: Env, before: torch.Tensor, after: torch.Tensor | None = None, *, nstep: int, dynamics: bool = True,
    inputs: bool = True,
) -> np.ndarray:  # fmt: skip
    """Step every world with ``mj_step``, and return its coordinates, (nworld, nq).

    Args:
        env: The environment that the states belong to.
        before: Initial states, (nworld, state_space.size).
        after: States with the controls and inputs of the step; by default ``before``.
        nstep: Number of substeps.
        dynamics: If True, the step uses the model fields in ``before``; otherwise, it uses the nominal model fields.
        inputs: If True, the step uses the inputs in ``after``; otherwise, it uses the inputs in ``before``.
    """
    parts, size = env.state_space.parts, env.engine.integration_size
    start = before.cpu().numpy().copy()
    if after is not None:
        for name in ("ctrl", *(INPUTS if inputs else ())):
            if name in parts:
                start[:, parts[name]] = after.cpu().numpy()[:, parts[name]]
    result = np.zeros((env.nworld, env.task.model.nq))
    for world, row in enumerate(start):
        model = copy.copy(env.task.model)
        if dynamics and env.task.dynamics:
            for field in env.task.dynamics:
                value = row[parts[field.name]]
                if field.option and not np.ndim(getattr(model.opt, field.name)):
                    setattr(model.opt, field.name, value.item())
                else:
                    field.value(model)[:] = value.reshape(field.value(model).shape)
            mujoco.mj_setConst(model, mujoco.MjData(model))
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, row[:size], mujoco.mjtState.mjSTATE_INTEGRATION.value)
        mujoco.mj_step(model, data, nstep)
        result[world] = data.qpos
    return result


def closer(
    ctx: Context, state: torch.Tensor, wanted: np.ndarray, without: np.ndarray, mask: torch.Tensor, what: str
) -> None:
    """Fail if ``qpos`` of a selected world is nearer to the values ``without`` than to the values ``wanted``."""
    qpos = state[:, ctx.a.state_space.parts["qpos"]].cpu().numpy()
    effect = np.abs(wanted - without).max(axis=1)
    error = np.abs(qpos - wanted).max(axis=1)
    wrong = (effect > _SMALLEST) & (error > 0.5 * effect) & mask.cpu().numpy()
    ctx.that(
        not wrong.any(),
        f"{what} of the worlds {np.flatnonzero(wrong).tolist()} should move qpos by {effect[wrong].tolist()}, "
        f"but leave an error of {error[wrong].tolist()}",
    )


def check_inputs(ctx: Context) -> None:
    """Inputs from ``control`` act in the same step and are part of the state. A reset clears them."""
    written = [name for name in INPUTS if name in ctx.a.task.writes["control"]]
    if not written:
        return
    ctx = converged(ctx)
    env, b = ctx.a, ctx.b
    parts, nstep = env.state_space.parts, env.task.frame_skip
    with ctx.changed(env, autoreset=False, horizon=0):
        for i, action in enumerate(ctx.actions(SHORT)):
            before = env.get_state()
            b.set_state(before)
            b.action.copy_(action)
            b.worlds.act()
            env.step(action)
            after = env.get_state()
            calm = ctx.calm(env) & ~ctx.faulty(env)
            for name in written:
                array = torch_view(flat(b.engine.arrays[name]))
                what = f"{name} in the state of step {i}, against what control wrote"
                ctx.equal(after[calm][:, parts[name]].float(), array[calm], what)
            wanted = predicted(env, before, after, nstep=nstep)
            without = predicted(env, before, after, nstep=nstep, inputs=False)
            closer(ctx, after, wanted, without, calm, f"inputs written at step {i}")
    for which, functions in {"reset": ["initialize"], "rand_reset": ["initialize", "randomize"]}.items():
        ctx.run(env, ctx.actions(2))
        getattr(env, which)()
        state = env.get_state()
        for name in written:
            if not any(name in env.task.writes[function] for function in functions):
                initial = torch.as_tensor(env.engine.initial[parts[name]], device=state.device)
                wanted_row = initial.float().expand(env.nworld, -1).contiguous()
                ctx.equal(state[:, parts[name]].float(), wanted_row, f"{name} after {which}")


def check_dynamics(ctx: Context) -> None:
    """A world's model fields are part of its state and affect its physics.

    Random changes do not accumulate over resets.
    """
    varied = [field.name for field in ctx.a.task.dynamics]
    if not varied:
        return
    ctx = converged(ctx)
    a, b = ctx.a, ctx.b
    parts = a.state_space.parts
    once = [name for name in varied if name not in a.task.reset_dynamics]

    def rows(env: Env, name: str) -> torch.Tensor:
        return torch_view(flat(env.engine.arrays[name])).clone()

    def compare(env: Env, state: torch.Tensor, when: str) -> None:
        for name in varied:
            ctx.equal(state[:, parts[name]].float(), rows(env, name), f"{name} in the state {when}")

    first = a.get_state()
    compare(a, first, "after rand_reset")
    with ctx.changed(a, b, autoreset=False, horizon=0):
        for i, action in enumerate(ctx.actions(SHORT)):
            before = a.get_state()
            a.step(action)
            after = a.get_state()
            compare(a, after, f"after step {i}")
            skip = a.task.frame_skip
            wanted = predicted(a, before, after, nstep=skip)
            without = predicted(a, before, after, nstep=skip, dynamics=False)
            closer(ctx, after, wanted, without, ctx.calm(a) & ~ctx.faulty(a), f"model fields at step {i}")
        b.rand_reset(ctx.seed + 7)
        b.set_state(after)
        compare(b, after, "after set_state")
    # b skips these resets, but has the same episode number
    for _ in range(3 * SHORT):
        a.rand_reset()
    late = a.get_state()
    early = first.clone()
    early[:, parts["episode"]] = late[:, parts["episode"]]
    if (lasting := memory_columns(a.task, a.state_space).get("lasting_memory")) is not None:
        early[:, lasting] = late[:, lasting]
    b.set_state(early)
    a.rand_reset()
    b.rand_reset()
    for name in varied:
        ctx.equal(rows(a, name), rows(b, name), f"{name} drawn after {3 * SHORT} resets")
    for name in once:
        ctx.equal(rows(a, name), first[:, parts[name]].float(), f"{name}, drawn once, after {3 * SHORT} resets")
    a.rand_reset(ctx.seed)
    ctx.equal(a.get_state()[:, : a.engine.state_size], first[:, : a.engine.state_size], "the same seed again")
    a.reset()
    for name in varied:
        if name in once:
            ctx.equal(rows(a, name), first[:, parts[name]].float(), f"{name}, drawn once, after reset")
        elif name not in a.task.writes["initialize"]:
            ctx.equal(rows(a, name), a.worlds.nominal_rows(name).contiguous(), f"{name} after reset")


def check_settle(ctx: Context) -> None:
    """An episode starts at time 0 after the substeps of ``settle``."""
    nstep = ctx.a.task.definition.settle
    if nstep == 0:
        return
    ctx = converged(ctx)
    a, b = ctx.a, ctx.b
    b.worlds.set_mask(None)
    for phase in b.worlds.reset_phases(randomly=True):
        if phase.name != "settle":
            phase.run()
    a.rand_reset()
    ctx.that((a.time == 0).all(), f"the time after a reset is {a.time.tolist()}")
    start = b.get_state()
    wanted, moved = predicted(a, start, nstep=nstep), start[:, a.state_space.parts["qpos"]].cpu().numpy()
    closer(ctx, a.get_state(), wanted, moved, torch.ones_like(a.done), "settling")
