"""Check the attributes of a task's class."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.core.task import FUNCTIONS
from lyceum_warp.support.suggestions import did_you_mean

_LOWEST = {"frame_skip": 1, "draws": 1, "settle": 0, "horizon": 0, "success_steps": 1}
"""Attributes that are whole numbers, each with its smallest value."""


def check_attributes(source: TaskSource) -> None:
    """Raise a ValueError if an attribute of a task's class breaks a rule."""
    for problem in _problems(source.definition, source):
        raise ValueError(f"the task {source.name!r} {problem}")


def _problems(task: Any, source: TaskSource) -> Iterator[str]:
    for name, low in _LOWEST.items():
        value = getattr(task, name)
        if not isinstance(value, int) or value < low:
            yield f"has {name} = {value!r}: it must be a whole number, at least {low}"
    if task.success_steps > 1 and source.functions["success"] is None:
        yield f"has success_steps = {task.success_steps}, but no {FUNCTIONS['success'].signature}: add this function"
    if task.success_steps > task.horizon > 0:
        yield (
            f"has success_steps = {task.success_steps}, but an episode has {task.horizon} steps, so no episode can "
            "succeed: lower success_steps, or raise horizon"
        )
    if unknown := [name for name in task.params if name not in source.params.vars]:
        hint = did_you_mean(unknown[0], source.params.vars, "add it to Params")
        yield f"has {unknown[0]!r} in params, which is no field of Params: {hint}"
    for attribute in ("lagged", "cleared"):
        for name in getattr(task, attribute):
            if name not in source.world.vars:
                yield f"has {name!r} in {attribute}: make it a field of World, too"
    metrics = source.terms.metrics
    for name in metrics:
        if not name.isprintable() or not set(name).isdisjoint(",'\""):
            yield f"has the metric {name!r}: a column's name in metrics.csv has no comma, quote or line break"
        if metrics.count(name) > 1:
            yield f"names the metric {name!r} twice: give each one name"
    if source.functions["measure"] is not None and not task.metrics:
        yield f"has {FUNCTIONS['measure'].signature}, but does not name its metrics: add metrics = (...) to its class"
    if (bounds := task.action_range) is not None and not -math.inf < bounds[0] < bounds[1] < math.inf:
        yield f"has action_range = {bounds!r}: it must be two finite numbers, lowest first, such as (-1.0, 1.0)"
    if task.actions is not None and not (isinstance(task.actions, Mapping) and task.actions):
        yield f"has actions = {task.actions!r}: it must be a dict of names and sizes, such as {{'speed': 1}}"
    if task.actions is not None and source.functions["control"] is None:
        yield f"defines its own actions, so it needs {FUNCTIONS['control'].signature}"
