"""Check the attributes of a task's class, and the names of its functions and fields."""

import itertools
import math
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import warp as wp

from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.core.fields import DATA_FIELDS, is_data_field
from lyceum_warp.core.model_fields import VARYING_FIELDS, is_model_field
from lyceum_warp.core.task import FUNCTIONS, GROUP_PREFIX, MEMORIES, Task
from lyceum_warp.support.suggestions import closest, did_you_mean

_LOWEST = {"frame_skip": 1, "draws": 1, "settle": 0, "horizon": 0, "success_steps": 1}
"""Attributes that are whole numbers, each with its smallest value."""


def check_attributes(source: TaskSource, fields: Collection[str] = ()) -> None:
    """Raise a ValueError if an attribute of a task's class breaks a rule, or if a name is misspelt.

    ``fields`` are names of further fields of MjData and MjModel.
    """
    for name, candidates, similarity in _new_names(source):
        if guess := closest(name, candidates, 1, similarity):
            raise ValueError(f"the name {name!r} is unknown: did you mean {guess[0]}?")
    for problem in _problems(source.definition, source):
        raise ValueError(problem)
    check_fields(name for name in (*source.types, *fields) if name not in MEMORIES)


def check_fields(names: Iterable[str]) -> None:
    """Raise a ValueError unless MjData or MjModel has a field of each name."""
    for name in names:
        if not (is_data_field(name) or is_model_field(name)):
            fields = [*DATA_FIELDS, *VARYING_FIELDS]
            hint = did_you_mean(name, fields, "fields have MuJoCo's names, of MjData and MjModel")
            raise ValueError(f"there is no field {name!r}: {hint}")


def _new_names(source: TaskSource) -> Iterator[tuple[str, Collection[str], float]]:
    """Yield names that would have no effect if they were misspelt, with known names and the least similarity."""
    attributes = {*(name for name in vars(Task) if not name.startswith("_")), *FUNCTIONS, "World", "Params"}
    for name in vars(source.definition):
        if name not in attributes and not name.startswith(("_", GROUP_PREFIX)):
            yield name, attributes, 0.75
    for name in source.definition.params:
        if name not in source.params.vars:
            yield name, source.params.vars, 0.6
    missing = [name for name, function in source.functions.items() if function is None]
    function_names = {*FUNCTIONS, *source.terms.functions}
    for name, value in vars(sys.modules[source.definition.__module__]).items():
        if isinstance(value, wp.Function) and name not in function_names and source.world in value.input_types.values():
            yield name, missing, 0.85


def _problems(task: Any, source: TaskSource) -> Iterator[str]:
    groups = _wrong_numbers, _wrong_names, _wrong_metrics, _wrong_actions
    return itertools.chain.from_iterable(group(task, source) for group in groups)


def _wrong_numbers(task: Any, source: TaskSource) -> Iterator[str]:
    for name, low in _LOWEST.items():
        value = getattr(task, name)
        if not isinstance(value, int) or value < low:
            yield f"{name} = {value!r} must be a whole number, at least {low}"
    if task.success_steps > 1 and source.functions["success"] is None:
        yield f"success_steps = {task.success_steps}, but no {FUNCTIONS['success'].signature}: add this function"
    if task.success_steps > task.horizon > 0:
        yield (
            f"success_steps = {task.success_steps}, but an episode has {task.horizon} steps, so no episode can "
            "succeed: lower success_steps, or raise horizon"
        )


def _wrong_names(task: Any, source: TaskSource) -> Iterator[str]:
    if unknown := [name for name in task.params if name not in source.params.vars]:
        yield f"params has {unknown[0]!r}, which is no field of Params: it has {', '.join(source.params.vars)}"
    for attribute in ("lagged", "cleared"):
        for name in getattr(task, attribute):
            if name not in source.world.vars:
                yield f"{attribute} has {name!r}: make it a field of World, too"
    if writers := [name for name, fields in source.writes.items() if "object" in fields]:
        yield f"{writers[0]} writes object, which the environment chooses: read it only"
    twice = source.drawn_between_steps & source.writes["startup"]
    if both := [name for name in source.types if is_model_field(name) and name in twice]:
        yield f"the model field {both[0]!r} is written by startup and by resets or events: write it in one of them"


def _wrong_metrics(task: Any, source: TaskSource) -> Iterator[str]:
    metrics = source.terms.metrics
    for name in metrics:
        if not name.isprintable() or not set(name).isdisjoint(",'\""):
            yield f"the metric {name!r}: a column's name in metrics.csv has no comma, quote or line break"
        if metrics.count(name) > 1:
            yield f"the metric {name!r} is named twice: give each one name"
    if source.functions["measure"] is not None and not task.metrics:
        yield f"{FUNCTIONS['measure'].signature} has no names for its metrics: add metrics = (...) to the class"


def _wrong_actions(task: Any, source: TaskSource) -> Iterator[str]:
    if (bounds := task.action_range) is not None and not -math.inf < bounds[0] < bounds[1] < math.inf:
        yield f"action_range = {bounds!r} must be two finite numbers, lowest first, such as (-1.0, 1.0)"
    if task.actions is not None and not (isinstance(task.actions, Mapping) and task.actions):
        yield f"actions = {task.actions!r} must be a dict of names and sizes, such as {{'speed': 1}}"
    if task.actions is not None and source.functions["control"] is None:
        yield f"a task with actions of its own needs {FUNCTIONS['control'].signature}"
