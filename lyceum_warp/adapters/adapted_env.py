"""Make or check the environment that an adapter uses, and split values by world."""

from collections.abc import Mapping
from typing import Any

import torch

from lyceum_warp.core import Task
from lyceum_warp.env import Env, make


def environment_of(
    task: str | type[Task] | Env, num_envs: int | None, options: Mapping[str, Any], *, autoreset: bool
) -> Env:
    """Make an adapter's environment from a task, or check the given environment."""
    if not isinstance(task, Env):
        return make(task, nworld=1 if num_envs is None else num_envs, autoreset=autoreset, **options)
    if options:
        raise ValueError(f"the environment already has its options: pass {', '.join(options)} to lw.make")
    if num_envs not in (None, task.nworld):
        raise ValueError(f"the environment has {task.nworld} worlds, not num_envs={num_envs}: omit num_envs")
    if task.autoreset is not autoreset:
        raise ValueError(f"the environment has autoreset={task.autoreset}: make it with autoreset={autoreset}")
    return task


def per_world(value: Any, nworld: int) -> list[Any]:
    """Split a tensor with one row per world, or repeat any other value."""
    if isinstance(value, torch.Tensor) and value.ndim and len(value) == nworld:
        return list(value)
    return [value] * nworld
