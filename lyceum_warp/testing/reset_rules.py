"""Check how episodes start: from a keyframe, after rejected states, after the substeps of ``settle``."""

import numpy as np
import torch
import warp as wp

from lyceum_warp.support.arrays import launch_worlds, torch_view
from lyceum_warp.testing.context import Context
from lyceum_warp.testing.physics_rules import closer, predicted

_RESETS = 6


def check_keyframe(ctx: Context) -> None:
    """A reset starts from the task's keyframe."""
    env = ctx.a
    if (name := env.task.task.keyframe) is None:
        return
    key = env.task.model.key(name)
    env.engine.reset(env.worlds.everyone)
    state = env.get_state()
    env.rand_reset(ctx.seed)
    given = {"qpos": key.qpos, "qvel": key.qvel, "act": key.act, "ctrl": key.ctrl, "mocap_pos": key.mpos}
    for part, values in given.items():
        if part in env.state_space.parts:
            wanted = torch.as_tensor(np.asarray(values).ravel().astype(np.float32), device=state.device).double()
            found = state[:, env.state_space.parts[part]]
            ctx.equal(found.float(), wanted.float().expand_as(found).contiguous(), f"{part} of the keyframe {name!r}")


def check_rejection(ctx: Context) -> None:
    """Each world draws initial states until one is accepted, up to the maximum number of draws."""
    a, b = ctx.a, ctx.b
    reject = a.task.kernels.reject_worlds
    if reject is None:
        return
    task, engine = a.task.task, a.engine
    count, rejected = torch.zeros(a.nworld, dtype=torch.int), wp.zeros(a.nworld, dtype=bool, device=a.device)
    reset = engine.reset

    def counted(mask: wp.array) -> None:
        count.add_(torch.from_numpy(mask.numpy().astype(np.int32)))
        reset(mask)

    with ctx.changed(a, graphs=False):
        ctx.restart()
        for i in range(_RESETS):
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


def check_settle(ctx: Context) -> None:
    """An episode starts at time 0 after the substeps of ``settle``."""
    a, b = ctx.a, ctx.b
    nstep = a.task.task.settle
    if nstep == 0:
        return
    ctx.restart()
    b.worlds.set_mask(None)
    for phase in b.worlds.reset_phases(randomly=True):
        if phase.name != "settle":
            phase.run()
    a.rand_reset()
    ctx.that((a.time == 0).all(), f"the time after a reset is {a.time.tolist()}")
    start = b.get_state()
    wanted, moved = predicted(a, start, nstep=nstep), start[:, a.state_space.parts["qpos"]].cpu().numpy()
    closer(ctx, a.get_state(), wanted, moved, torch.ones_like(a.done), "settling")
