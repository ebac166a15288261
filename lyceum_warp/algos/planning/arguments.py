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
from lyceum_warp.binding import TaskSource, errors_of, task_name, task_spec
from lyceum_warp.core.options import OPTIONS, EnvOptions, suggestion
from lyceum_warp.core.task import Planning, Task
from lyceum_warp.engines.placement import place_samples
from lyceum_warp.support.validate import check_kind, whole_number


def task_config(task: type[Task], value: object = None) -> MPPIConfig:
    """Make a planner's settings from a task's ``planning``.

    Args:
        task: The task.
        value: The planner's value function. If it has a ``discount``, this replaces the task's discount.

    Raises:
        ValueError: The task's ``planning`` is not valid.
    """
    config, _ = _planning(task)
    return config if getattr(value, "discount", None) is None else dataclasses.replace(config, discount=None)


def planner_arguments(
    task: type[Task],
    config: MPPIConfig | None,
    kwargs: Mapping[str, Any],
    params: Mapping[str, Any] | None,
    value: object,
    plants: int = 1,
) -> tuple[MPPIConfig, EnvOptions, dict[str, Any]]:
    """Divide a planner's arguments into settings, options and parameters; defaults come from ``planning``.

    Args:
        task: The task.
        config: Settings that replace the task's settings.
        kwargs: Keyword arguments, which are settings, options of the worlds or parameters of the task. A setting of
            None is ignored.
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
    name, names = task_name(task), _parameter_names(task)
    settings = {key: kwargs[key] for key in kwargs if key in SETTINGS}
    options = {key: kwargs[key] for key in kwargs if key in OPTIONS and key not in SETTINGS}
    parameters = {key: kwargs[key] for key in kwargs if key not in settings and key not in options}
    if ambiguous := [key for key in settings if key in names]:
        raise ValueError(
            f"{ambiguous[0]!r} is a setting of MPPI and a parameter of the task {name!r}: pass the setting as "
            f"config=lw.MPPIConfig({ambiguous[0]}=...), or the parameter as params={{{ambiguous[0]!r}: ...}}"
        )
    config = config or task_config(task, value)
    config = config.changed({key: setting for key, setting in settings.items() if setting is not None})
    config = config.completed(value)

    _check_options(options)
    env_options = _planning(task)[1].changed(options)
    env_options = env_options.changed({"physics": env_options.physics.resolved(task.physics)})
    place = place_samples(
        env_options.engine, env_options.device, nthread=env_options.nthread,
        samples=config.samples * config.models * plants, spec=partial(task_spec, task, env_options.model),
        solver=env_options.physics.solver,
    )  # fmt: skip

    parameters = {**(task.planning.params if value is None else {}), **parameters, **(params or {})}
    if unknown := [key for key in parameters if key not in names]:
        raise ValueError(f"the task {name!r} has no parameter {unknown[0]!r}: {_hint(unknown[0], names)}")
    return config, env_options.changed(place), parameters


def plant_seeds(seed: Any, plants: int) -> Sequence[int]:
    """Derive each plant's seed from the first plant's seed, or check a list of seeds.

    Raises:
        ValueError: A seed is negative or not a whole number, or the list does not contain ``plants`` seeds.
    """
    seeds = seed.tolist() if isinstance(seed, (np.ndarray, torch.Tensor)) else seed
    if not isinstance(seeds, list | tuple | range):
        first = whole_number("seed", seeds, low=0, high=2**31 - plants)
        return range(first, first + plants)
    if len(seeds) != plants:
        raise ValueError(f"seed must be a number, or a list with a number for each of {plants} plants, not {seeds!r}")
    return [whole_number("seed", seed, low=0) for seed in seeds]


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
    "cameras": "plans are judged by states",
    "first_world": "no other process has samples",
}
"""Options that only the planner may set, each with the reason."""


def _check_options(options: Mapping[str, Any]) -> None:
    for name in options:
        if name in _OWN_OPTIONS:
            raise ValueError(f"a planner takes no option {name}: {_OWN_OPTIONS[name]}")
        if name not in OPTIONS:
            raise ValueError(f"there is no option {name!r}: {suggestion(name)}")


def _hint(name: str, names: Sequence[str]) -> str:
    if name in SETTINGS or name in OPTIONS:  # given in params
        return "it is a setting of MPPI or an option of its worlds: give it outside params"
    settings = [setting for setting in SETTINGS if setting not in OPTIONS]
    return suggestion(name, [*settings, *names]) or f"it has {', '.join(names) or 'none'}"


def _parameter_names(task: type[Task]) -> list[str]:
    with errors_of(task):
        source = TaskSource(task)
    return [name for name in (*source.params.vars, *source.terms.weights) if name != "dt"]


def _planning(task: type[Task]) -> tuple[MPPIConfig, EnvOptions]:
    """Make the settings and the options of a task's ``planning``."""
    planning, name = task.planning, task_name(task)
    check_kind(f"planning of the task {name!r}", planning, Planning, "as lw.Planning(settings={'horizon': 16})")
    try:
        config = MPPIConfig(**planning.settings)
        _check_options(planning.options)
        options = EnvOptions().changed(planning.options)
        options = options.changed({"physics": options.physics.resolved(task.physics)})
    except (TypeError, ValueError) as error:
        raise ValueError(f"planning of the task {name!r}: {error}") from error
    return config, options
