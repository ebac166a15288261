"""The arguments of a call of MPPI: sorted, and completed from the task's planning."""

import contextlib
import dataclasses
import difflib
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from lyceum_warp.algos.mppi_config import SETTINGS, MPPIConfig
from lyceum_warp.algos.plan_update import PlanUpdate
from lyceum_warp.binding.bound_task import task_spec
from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.binding.registry import task_name
from lyceum_warp.engines.memory import NotEnoughMemoryError
from lyceum_warp.engines.placement import place_samples
from lyceum_warp.options import OPTIONS, EnvOptions, suggestion
from lyceum_warp.support.validate import described, whole_number
from lyceum_warp.task import Planning, Task


def task_config(task: type[Task], value: object = None) -> MPPIConfig:
    """The settings that a task gives in its ``planning``.

    Args:
        task: The task.
        value: The planner's value function; its ``discount``, if it has one, replaces the task's.

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
    """Sort the arguments of a call of MPPI, and complete them from the task's ``planning``.

    Args:
        task: The task.
        config: Settings in place of the task's.
        words: The flat keyword arguments: single settings, options of the worlds, parameters of the task. A setting
            of None is not given.
        params: Parameters of the task.
        value: The value function. With one the parameters in ``planning`` do not apply.
        plants: Number of plants to plan for.

    Returns:
        The settings, the options of the planner's worlds with the engine and the device that suit the number of
        samples, and the parameters of the planner's worlds.

    Raises:
        ValueError: A word is unknown or ambiguous, or a value is not valid.
    """
    if config is not None and not isinstance(config, MPPIConfig):
        raise ValueError(f"config must be a lw.MPPIConfig, as lw.MPPIConfig(horizon=16), not {described(config)}")
    if params is not None and not isinstance(params, Mapping):
        raise ValueError(f"params must be a dict of parameters of the task, not {described(params)}")
    name, planning, known = task_name(task), _planning(task), _parameter_names(task)
    for word in words:
        if word in SETTINGS and word in known:
            raise ValueError(
                f"{word!r} is a setting of MPPI and a parameter of the task {name!r}: give the setting as "
                f"config=lw.MPPIConfig({word}=...), or the parameter as params={{{word!r}: ...}}"
            )
    config = (task_config(task, value) if config is None else config).changed(
        {word: words[word] for word in words if word in SETTINGS and words[word] is not None}
    )
    config = config.completed(value)

    given = {word: words[word] for word in words if word in OPTIONS and word not in SETTINGS}
    _check_options(given)
    options = EnvOptions().changed(planning.options).changed(given)

    rest = {word: words[word] for word in words if word not in SETTINGS and word not in OPTIONS}
    rest |= params or {}
    for word in rest:
        if word not in known:
            raise ValueError(f"the task {name!r} has no parameter {word!r}: {_hint(word, known)}")
    place = place_samples(
        options.engine, options.device, nthread=options.nthread, samples=config.samples * config.models * plants,
        spec=partial(task_spec, task, options.model), solver=options.physics.solver,
    )  # fmt: skip
    return config, options.changed(place), dict(planning.params if value is None else {}) | rest


def plant_seeds(seed: int | Sequence[int], plants: int) -> Sequence[int]:
    """A seed for each plant, from that of the first one or from a list.

    Raises:
        ValueError: A seed is not a whole number from 0, or there are too few or too many.
    """
    given: Any = seed
    if isinstance(given, (np.ndarray, torch.Tensor)):
        given = given.tolist()
    if isinstance(given, Sequence) and not isinstance(given, str):
        if len(given) != plants:
            raise ValueError(f"seed must be a number, or a list with one for each of {plants} plants, not {given!r}")
        return [whole_number("seed", one, low=0) for one in given]
    first = whole_number("seed", given, low=0, high=2**31 - plants)
    return range(first, first + plants)


@contextlib.contextmanager
def explained_worlds(config: MPPIConfig, plants: int) -> Iterator[None]:
    """Make worlds of a planner; where they do not fit into memory, the error says which settings their number is from.

    Raises:
        NotEnoughMemoryError: They do not fit into memory.
    """
    try:
        yield
    except NotEnoughMemoryError as error:
        product = f"{plants} * {config.samples} * {config.models}"
        raise NotEnoughMemoryError(f"{error}, where nworld is plants * samples * models, {product}") from error


def words_of_update(update: str | None, words: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a call of CEM or predictive sampling as those of a call of MPPI.

    Args:
        update: The update that the planner has; None for MPPI, which has any.
        words: The flat keyword arguments.

    Raises:
        ValueError: They ask for another update.
    """
    if update is None:
        return dict(words)
    if words.get("update", update) != update:
        raise ValueError(f"update={words['update']!r} is another planner than {update!r}: call lw.MPPI with it")
    return {**words, "update": update}


def plain(value: Any) -> Any:
    """A setting, an option or a parameter as JSON can hold it."""
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Mapping):
        return {str(name): plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
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
    "first_world": "its worlds are all the samples that there are",
}
"""Options that the planner sets in its worlds, each with the reason."""


def _check_options(options: Mapping[str, Any]) -> None:
    for name in options:
        if name in _OWN_OPTIONS:
            raise ValueError(f"a planner takes no option {name}: {_OWN_OPTIONS[name]}")


def _hint(word: str, known: Sequence[str]) -> str:
    """What may have been meant by a parameter that the task does not have."""
    if word in SETTINGS or word in OPTIONS:  # only in params, because among the words it is that
        return f"it is {'a setting of MPPI' if word in SETTINGS else 'an option of its worlds'}: give it outside params"
    others = [setting for setting in SETTINGS if setting not in OPTIONS]
    return suggestion(word, [*others, *known]) or f"it has {', '.join(known) or 'none'}"


def _parameter_names(task: type[Task]) -> list[str]:
    return [name for name in TaskSource(task, task_name(task)).params.vars if name != "dt"]


def _planning(task: type[Task]) -> Planning:
    """A task's ``planning``, all of whose names are known."""
    planning, name = task.planning, task_name(task)
    if not isinstance(planning, Planning):
        raise ValueError(
            f"planning of the task {name!r} must be lw.Planning(settings={{...}}, options={{...}}, params={{...}}), "
            f"not {described(planning)}"
        )
    known = {"settings": SETTINGS, "options": OPTIONS, "params": _parameter_names(task)}
    for part, names in known.items():
        for word in getattr(planning, part):
            if word in names:
                continue
            other = next((other for other in known if word in known[other]), None)
            close = difflib.get_close_matches(word, names, 3)
            hint = f"it belongs to {other}" if other else f"did you mean {' or '.join(close)}?" if close else ""
            hint = hint or f"there are {', '.join(names) or 'none'}"
            raise ValueError(f"{word!r} in planning.{part} of the task {name!r} is unknown: {hint}")
    try:
        _check_options(planning.options)
        EnvOptions().changed(planning.options)
    except ValueError as error:
        raise ValueError(f"planning.options of the task {name!r}: {error}") from error
    return planning
