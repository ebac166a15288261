"""Divide a planner's arguments into settings, options and parameters, with defaults from the task's ``planning``."""

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from lyceum_warp.algos.planning.config import SETTINGS, MPPIConfig
from lyceum_warp.algos.planning.updates import PlanUpdate
from lyceum_warp.binding.bound_task import task_spec
from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.binding.registry import task_name
from lyceum_warp.core.options import OPTIONS, EnvOptions, suggestion
from lyceum_warp.core.task import Planning, Task
from lyceum_warp.engines.placement import place_samples
from lyceum_warp.support.validate import check_kind, described, whole_number


def task_config(task: type[Task], value: object = None) -> MPPIConfig:
    """Make a planner's settings from a task's ``planning``.

    Args:
        task: The task.
        value: The planner's value function. If it has a ``discount``, this replaces the task's discount.

    Raises:
        ValueError: The task's ``planning`` is not valid.
    """
    planning = _planning(task)
    try:
        config = MPPIConfig(**planning.settings)
    except ValueError as error:
        raise ValueError(f"planning.settings of the task {task_name(task)!r}: {error}") from error
    return config if getattr(value, "discount", None) is None else dataclasses.replace(config, discount=None)


def planner_arguments(
    task: type[Task],
    config: MPPIConfig | None,
    words: Mapping[str, Any],
    params: Mapping[str, Any] | None,
    value: object,
    plants: int = 1,
) -> tuple[MPPIConfig, EnvOptions, dict[str, Any]]:
    """Divide a planner's arguments into settings, options and parameters; defaults come from ``planning``.

    Args:
        task: The task.
        config: Settings that replace the task's settings.
        words: Keyword arguments, which are settings, options of the worlds or parameters of the task. A setting of None
            is ignored.
        params: Parameters of the task.
        value: The value function. With a value function, the parameters in ``planning`` are ignored.
        plants: Number of plants to plan for.

    Returns:
        The planner's settings, the options of its worlds, and the task's parameters. The options include an engine and
        a device that suit the number of samples.

    Raises:
        ValueError: A keyword is unknown or ambiguous, or a value is not valid.
    """
    check_kind("config", config, MPPIConfig | None, "as lw.MPPIConfig(horizon=16)")
    check_kind("params", params, Mapping | None, "a dict of parameters of the task")
    name, planning, known = task_name(task), _planning(task), _parameter_names(task)
    if both := [word for word in words if word in SETTINGS and word in known]:
        raise ValueError(
            f"{both[0]!r} is a setting of MPPI and a parameter of the task {name!r}: pass the setting as "
            f"config=lw.MPPIConfig({both[0]}=...), or the parameter as params={{{both[0]!r}: ...}}"
        )
    config = config or task_config(task, value)
    config = config.changed({word: words[word] for word in words if word in SETTINGS and words[word] is not None})
    config = config.completed(value)

    given = {word: words[word] for word in words if word in OPTIONS and word not in SETTINGS}
    _check_options(given)
    options = EnvOptions().changed(planning.options).changed(given)
    options = options.changed({"physics": options.physics.resolved(task.physics)})

    rest = {word: words[word] for word in words if word not in SETTINGS and word not in OPTIONS} | dict(params or {})
    if unknown := [word for word in rest if word not in known]:
        raise ValueError(f"the task {name!r} has no parameter {unknown[0]!r}: {_hint(unknown[0], known)}")
    place = place_samples(
        options.engine, options.device, nthread=options.nthread, samples=config.samples * config.models * plants,
        spec=partial(task_spec, task, options.model), solver=options.physics.solver,
    )  # fmt: skip
    return config, options.changed(place), dict(planning.params if value is None else {}) | rest


def plant_seeds(seed: int | Sequence[int], plants: int) -> Sequence[int]:
    """Derive each plant's seed from the first plant's seed, or check a list of seeds.

    Raises:
        ValueError: A seed is negative or not a whole number, or the list does not contain ``plants`` seeds.
    """
    given: Any = seed
    if isinstance(given, (np.ndarray, torch.Tensor)):
        given = given.tolist()
    if isinstance(given, Sequence) and not isinstance(given, str):
        if len(given) != plants:
            raise ValueError(
                f"seed must be a number, or a list with a number for each of {plants} plants, not {given!r}"
            )
        return [whole_number("seed", one, low=0) for one in given]
    first = whole_number("seed", given, low=0, high=2**31 - plants)
    return range(first, first + plants)


def plain(value: Any) -> Any:
    """Convert a setting, an option or a parameter to a value that JSON supports.

    Pass this function to ``json.dumps`` as the argument ``default``.
    """
    if isinstance(value, mujoco.MjSpec):
        return f"MjSpec {value.modelname!r}"
    if isinstance(value, PlanUpdate):
        return repr(value)
    if isinstance(value, Path) or callable(value):
        return getattr(value, "__name__", str(value))
    return (value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)).tolist()


_OWN_OPTIONS = {
    "nworld": "samples is the number of its worlds, for each of its models and plants",
    "autoreset": "its worlds never reset",
    "horizon": "episodes of its worlds have no limit, and the horizon of a plan is a setting",
    "seed": "every sample starts from the state to plan from",
    "first_world": "no other process has samples",
}
"""Options that only the planner may set, each with the reason."""


def _check_options(options: Mapping[str, Any]) -> None:
    for name in options:
        if name in _OWN_OPTIONS:
            raise ValueError(f"a planner takes no option {name}: {_OWN_OPTIONS[name]}")


def _hint(word: str, known: Sequence[str]) -> str:
    if word in SETTINGS or word in OPTIONS:  # given in params
        return f"it is {'a setting of MPPI' if word in SETTINGS else 'an option of its worlds'}: give it outside params"
    others = [setting for setting in SETTINGS if setting not in OPTIONS]
    return suggestion(word, [*others, *known]) or f"it has {', '.join(known) or 'none'}"


def _parameter_names(task: type[Task]) -> list[str]:
    source = TaskSource(task, task_name(task))
    return [name for name in (*source.params.vars, *source.terms.weights) if name != "dt"]


def _planning(task: type[Task]) -> Planning:
    """Return a task's ``planning`` after checking that every name in it is known."""
    planning, name = task.planning, task_name(task)
    if not isinstance(planning, Planning):
        raise ValueError(
            f"planning of the task {name!r} must be lw.Planning(settings={{...}}, options={{...}}, params={{...}}), "
            f"not {described(planning)}"
        )
    known = {"settings": SETTINGS, "options": OPTIONS, "params": _parameter_names(task)}
    for part, names in known.items():
        if unknown := [word for word in getattr(planning, part) if word not in names]:
            hints = [f"it belongs to {other}" for other in known if unknown[0] in known[other]]
            hints += [suggestion(unknown[0], set(names) - set(OPTIONS)), f"there are {', '.join(names) or 'none'}"]
            hint = next(filter(None, hints))
            raise ValueError(f"{unknown[0]!r} in planning.{part} of the task {name!r} is unknown: {hint}")
    try:
        _check_options(planning.options)
        EnvOptions().changed(planning.options).physics.resolved(task.physics)
    except ValueError as error:
        raise ValueError(f"planning.options of the task {name!r}: {error}") from error
    return planning
