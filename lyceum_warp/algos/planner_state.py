"""Make and check the initial states of plans."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from lyceum_warp.env import Env
from lyceum_warp.support.validate import described


def state_from_parts(env: Env, initial: torch.Tensor, parts: Mapping[str, Any]) -> torch.Tensor:
    """Copy a state, (state_space.size,) float64, and replace the given parts; see ``Planner.state_of``."""
    space, state = env.state_space, initial.clone()
    for name, value in parts.items():
        if name not in space.parts:
            raise ValueError(f"a state of {env.task.name!r} has no part {name!r}: it has {list(space.parts)}")
        target = state[space.parts[name]]
        try:
            values = torch.as_tensor(value, dtype=torch.float64).ravel()
        except (TypeError, ValueError, RuntimeError) as error:
            raise ValueError(f"the part {name!r} of a state must be numbers, not {value!r}") from error
        if values.shape != target.shape:
            raise ValueError(f"the part {name!r} of a state has {len(target)} numbers, not {len(values)}")
        target.copy_(values)
    if "time" in parts and "step" not in parts:
        state[space.parts["step"]] = torch.round(state[space.parts["time"]] / env.timestep)
    return state


def checked_state(env: Env, state: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Check the state to plan from, or the states of all plants, and unpack a single row.

    Args:
        env: The environment of the states.
        state: The state, (state_space.size,) float64, or the states, (plants, state_space.size).
        like: The buffer that will receive the state or states.

    Raises:
        ValueError: The state has the wrong shape or type, or is on the CPU and not finite.
    """
    if isinstance(state, torch.Tensor) and state.ndim == 2 and len(state) == 1 and like.ndim == 1:
        state = state[0]
    if not isinstance(state, torch.Tensor) or state.shape != like.shape or state.dtype != like.dtype:
        parts = "plan.state_of(qpos=..., qvel=...)"
        if like.ndim == 1:
            which, hint = "a state", f"make it from its parts with {parts}"
        else:
            which, hint = "the states", f"stack one {parts} for each plant"
        raise ValueError(
            f"{which} to plan from must be {described(like)}, not {described(state)}: call env.get_state() of the same "
            f"task, or {hint}. (With fields=[...], an environment's states may be longer.)"
        )
    # a check on a GPU would wait for the device; an unchecked non-finite state only makes all samples fail
    if state.device.type != "cpu":
        return state
    values = state.numpy().ravel()
    # a plan may take only a millisecond, so check with a fast dot product first
    if not math.isfinite(values.dot(values)) and not (finite := np.isfinite(values)).all():
        where = int(np.flatnonzero(~finite)[0])
        plant, column = divmod(where, env.state_space.size)
        part = next(n for n, part in env.state_space.parts.items() if part.start <= column < part.stop)
        which = "the state" if like.ndim == 1 else f"the state of plant {plant}"
        raise ValueError(f"{which} to plan from has {values[where]} in its {part!r}: states must be finite")
    return state
