"""Check the optional parts of a task: events and substeps."""

import torch

from lyceum_warp.env import memory_columns
from lyceum_warp.kernels.step_types import OUTCOMES
from lyceum_warp.support.arrays import launch_worlds, torch_view
from lyceum_warp.testing.context import SHORT, Context


def check_events(ctx: Context) -> None:
    """An event runs after a step's reward and termination, and changes the state and the next observation.

    It does not run in worlds that restart, and does not affect other worlds.
    """
    a, b = ctx.a, ctx.b
    if a.task.functions["event"] is None:
        return
    with ctx.changed(a, b, horizon=5):
        for i, action in enumerate(ctx.actions(2 * SHORT)):
            b.set_state(a.get_state())
            b.action.copy_(action)
            phases = b.worlds.step_phases()
            for phase in phases:
                if not phase.name.startswith("event") and phase.name != "observe":
                    phase.run()
            a.step(action)
            for name in OUTCOMES:
                ctx.equal(getattr(a, name), getattr(b, name), f"{name} of step {i} without the event")
            for name, final in a.final_obs_groups.items():
                ctx.equal(final, b.final_obs_groups[name], f"the final group {name} of step {i} without the event")
            calm = ctx.calm(a)
            ctx.that(calm[a.done].all(), f"an event ran in worlds that restarted at step {i}")
            now, without = a.get_state(), b.get_state()
            ctx.equal(now[calm], without[calm], f"the state of worlds without an event at step {i}")
            ctx.that((now != without)[~calm].any(dim=1).all(), f"an event of step {i} is not in the state")
            next(phase for phase in phases if phase.name == "event").run()  # it writes the same fields as in a
            for name, columns in a.state_space.parts.items():
                if name in a.task.writes["event"] and name in b.worlds.fields:
                    array = torch_view(b.worlds.fields[name]).reshape(b.nworld, -1)
                    ctx.equal(
                        now[:, columns].to(array.dtype), array, f"{name} in the state after the event of step {i}"
                    )
            for name, obs in a.obs_groups.items():
                ctx.equal(a.get_obs(now, group=name), obs, f"the group {name} after the event of step {i}")


def check_substep(ctx: Context) -> None:
    """``substep`` runs after each substep and does not change the physics."""
    a, b = ctx.a, ctx.b
    substep = a.task.kernels.substep_memory
    if substep is None:
        return
    with ctx.changed(a, b, horizon=0, autoreset=False):
        memory = memory_columns(a.task, a.state_space)

        def start(state: torch.Tensor, action: torch.Tensor) -> None:
            b.set_state(state)
            b.action.copy_(action)
            b.worlds.act()

        for i, action in enumerate(ctx.actions(SHORT)):
            state = a.get_state()
            a.step(action)
            wanted, calm = a.get_state(), ctx.calm(a) & ~ctx.faulty(a)
            start(state, action)
            for _ in range(a.task.frame_skip):
                b.engine.step(1)
                launch_worlds(substep, b.nworld, [b.worlds.after, b.worlds.params], b.device)
            b.worlds.advance_memory()
            result = b.get_state()
            for name, columns in memory.items():
                ctx.equal(wanted[calm][:, columns], result[calm][:, columns], f"the {name} of step {i}, by substeps")
            start(state, action)
            b.engine.step(a.task.frame_skip)
            result = b.get_state()[:, : a.engine.integration_size]
            wanted = wanted[:, : a.engine.integration_size]
            ctx.equal(result[calm], wanted[calm], f"the physics of step {i} without substeps")
