"""Compute the layouts of a task's observations, from its attribute ``obs`` or from structs."""

import keyword
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

from lyceum_warp.binding import parts
from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.binding.sources import is_struct
from lyceum_warp.core.task import observer_name

_PARTS = 'the parts of its observation, as obs = {"position": 5}'


def obs_layouts(source: TaskSource, params: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """Compute the layout of each observation group from the task's parameters."""
    task = source.definition
    if not hasattr(task, "obs"):
        return {group: parts.sizes(slices) for group, slices in obs_slices(source, params).items()}
    obs = task.obs(SimpleNamespace(**params)) if callable(task.obs) else task.obs
    if not isinstance(obs, Mapping) or not obs:
        raise ValueError(f"obs is {obs!r}: add {_PARTS}")
    grouped = [isinstance(part, Mapping) for part in obs.values()]
    if not any(grouped):
        obs = {"policy": obs}
    elif not all(grouped) or "policy" not in obs:
        raise ValueError(
            "obs must be a dict of parts and sizes, or a dict of such dicts for groups, including 'policy', not "
            f"{obs!r}"
        )
    layouts = {}
    for group, sizes in obs.items():
        if not group.isidentifier() or keyword.iskeyword(group):
            raise ValueError(
                f"obs has the group {group!r}: a group's name must be a Python name, such as 'critic', whose function "
                "is observe_critic"
            )
        if per_world := [part for part, size in sizes.items() if np.ndim(size)]:
            raise ValueError(f"obs has sizes that differ between worlds, {per_world}: give one size for all worlds")
        layouts[group] = {part: int(size) for part, size in sizes.items() if size}
    return layouts


def obs_slices(source: TaskSource, params: Mapping[str, Any]) -> dict[str, parts.Layout]:
    """Compute the layouts of observation groups that are declared as structs."""
    if hasattr(source.definition, "obs"):
        return {}
    layouts = {}
    for group, struct in source.group_structs().items():
        if not is_struct(struct):
            raise ValueError(
                f"there is no obs: add {_PARTS} to its class, or let {observer_name(group)} take a struct of parts"
            )
        layouts[group] = parts.layout(struct, "obs", params, struct.key)
        if without_size := [name for name in struct.vars if name not in layouts[group]]:
            raise ValueError(
                f"{struct.key}.{without_size[0]} has no size: for three numbers, write {without_size[0]}: Row[float] = "
                "lw.part(3)"
            )
        if not layouts[group]:
            raise ValueError(f"the struct {struct.key} has no parts, such as x: Row[float] = lw.part()")
    return layouts
