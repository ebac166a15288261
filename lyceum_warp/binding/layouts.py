"""Compute the layouts of a task's rows: its observations, its actions, and its memory."""

import dataclasses
import keyword
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from lyceum_warp.binding import parts
from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.binding.sources import is_struct
from lyceum_warp.core.task import FUNCTIONS, MEMORIES, observer_name

_PARTS = 'the parts of its observation, as obs = {"position": 5}'


@dataclasses.dataclass(frozen=True)
class Layouts:
    """The parts of a task's rows. They depend on the task's parameters."""

    obs: dict[str, dict[str, int]]
    """The sizes of the parts of each observation group."""
    actions: dict[str, int] | None
    """The size of each part of an action, or None if the actions are MuJoCo's controls."""
    memory: dict[str, parts.Layout]
    """The layouts of ``memory`` and ``lasting_memory``."""
    shared: dict[str, parts.Layout]
    """The layouts of ``Shared`` and ``Sums``, or nothing."""
    structs: dict[str, parts.Layout]
    """The layouts of ``shared``, and of the observation groups that are declared as structs."""
    observers: dict[str, wp.Function]
    """The function of each observation group."""


def layouts_of(source: TaskSource, params: Mapping[str, Any]) -> Layouts:
    """Compute the layouts for given parameters."""
    obs, groups = observation_layouts(source, params)
    shared = {name: parts.layout(kind, "obs", params, name) for name, kind in source.shared_structs.items()}
    return Layouts(
        obs,
        action_sizes(source, params),
        memory={name: parts.layout(source.world, name, params, "World") for name in MEMORIES},
        shared=shared,
        structs=groups | shared,
        observers={group: source.observers[group] for group in obs},
    )


def observation_layouts(
    source: TaskSource, params: Mapping[str, Any]
) -> tuple[dict[str, dict[str, int]], dict[str, parts.Layout]]:
    """Compute the sizes of the parts of each observation group, and the layouts of groups that are structs."""
    if hasattr(source.definition, "obs"):
        return _declared_groups(source, params), {}
    groups = _struct_groups(source, params)
    return {group: parts.sizes(layout) for group, layout in groups.items()}, groups


def action_sizes(source: TaskSource, params: Mapping[str, Any]) -> dict[str, int] | None:
    """Compute the sizes of the parts of an action, or return None if actions are controls."""
    if source.definition.actions is None:
        return None
    sizes = source.definition.actions.items()
    return {name: parts.length(f"the size of the action {name!r}", size, params) for name, size in sizes}


def _declared_groups(source: TaskSource, params: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """Compute the sizes of the parts that ``obs`` lists, by group."""
    obs: Any = source.definition.obs
    if callable(obs):
        obs = obs(SimpleNamespace(**params))
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
        if group not in source.observers:
            form = dataclasses.replace(FUNCTIONS["observe"], name=observer_name(group))
            raise ValueError(f"the group {group!r} of observations needs the function {form.signature}")
        if per_world := [part for part, size in sizes.items() if np.ndim(size)]:
            raise ValueError(f"obs has sizes that differ between worlds, {per_world}: give one size for all worlds")
        layouts[group] = {part: int(size) for part, size in sizes.items() if size}
    return layouts


def _struct_groups(source: TaskSource, params: Mapping[str, Any]) -> dict[str, parts.Layout]:
    """Compute the layouts of observation groups that are declared as structs."""
    layouts = {}
    for group, observer in source.observers.items():
        struct: Any = list(observer.input_types.values())[2]
        if not is_struct(struct):
            raise ValueError(
                f"there is no obs: add {_PARTS} to the class, or let {observer_name(group)} take a struct of parts"
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
