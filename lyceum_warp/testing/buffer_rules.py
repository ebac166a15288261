"""Check spaces, buffers and the time."""

import torch

from lyceum_warp.core import COUNTERS
from lyceum_warp.testing.context import OUTCOMES, SHORT, Context


def check_spaces(ctx: Context) -> None:
    """A space has its buffer's shape and type, parts for all columns, and no lower bound above an upper bound."""
    env = ctx.a
    ctx.that(env.obs is env.obs_groups["policy"], "the group policy is not env.obs")
    ctx.that(env.final_obs is env.final_obs_groups["policy"], "the final group policy is not env.final_obs")
    pairs = {
        "action": (env.action_space, env.action), "reward": (env.reward_space, env.reward),
        "eval": (env.eval_space, env.eval), "state": (env.state_space, env.get_state()),
    }  # fmt: skip
    for name, space in env.obs_spaces.items():
        pairs[f"obs group {name}"] = space, env.obs_groups[name]
        pairs[f"final obs group {name}"] = space, env.final_obs_groups[name]
        ctx.equal(env.get_obs(group=name), env.obs_groups[name], f"get_obs of the group {name}")
    for name, (space, buffer) in pairs.items():
        ctx.that(
            buffer.shape == (env.nworld, *space.shape) and buffer.dtype == space.dtype,
            f"{name} is {buffer.dtype} {tuple(buffer.shape)}, its space {space.dtype} {space.shape}",
        )
        ends = [0, *(part.stop for part in space.parts.values())]
        starts = [part.start for part in space.parts.values()]
        ctx.that(starts == ends[:-1], f"the parts of the {name} space leave gaps: {dict(space.parts)}")
        if space.low is not None and space.high is not None:
            ctx.that(space.low.shape == space.high.shape == space.shape, f"bounds of {name} have another shape")
            ctx.that(
                bool((space.low <= space.high).all()),
                f"bounds of {name} are reversed: {space.low}, {space.high}",
            )
    for name in ("terminated", "truncated", "success", "done"):
        ctx.that(getattr(env, name).dtype == torch.bool, f"{name} is {getattr(env, name).dtype}")
    for name in (*OUTCOMES, "action", "time"):
        device = getattr(env, name).device
        ctx.that(device.type == ("cpu" if env.device.is_cpu else "cuda"), f"{name} lies on {device}")
    for part in ("time", "qpos", "qvel", *COUNTERS):
        ctx.that(part in env.state_space.parts, f"the state has no {part}; it has {list(env.state_space.parts)}")


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


def check_time(ctx: Context) -> None:
    """``env.time`` is 0 after a reset, and grows by ``env.timestep`` with each step."""
    env = ctx.a
    with ctx.changed(env, autoreset=False, horizon=0):
        for reset in (env.reset, env.rand_reset):
            reset()
            ctx.that((env.time == 0).all(), f"time is {env.time.tolist()} after {reset.__name__}")
            for i, action in enumerate(ctx.actions(SHORT), 1):
                env.step(action)
                wanted = torch.full_like(env.time, i * env.timestep)
                ctx.that(
                    torch.allclose(env.time, wanted, rtol=1e-5) or ctx.faulty(env).any(),
                    f"time is {env.time.tolist()} after {i} steps of {env.timestep} s",
                )
