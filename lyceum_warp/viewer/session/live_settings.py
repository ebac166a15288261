"""Read and change a planner's settings and a task's parameters while a session runs."""

import dataclasses
from typing import Any

import numpy as np

from lyceum_warp.algos import Planner
from lyceum_warp.env import Env
from lyceum_warp.viz import owner_of

_SETTINGS = ("noise", "temperature", "horizon", "samples")
_OF_THE_PLANNER = ("nworld", "autoreset", "horizon", "seed", "first_world", "cameras")
"""Options that a planner sets itself."""

Numbers = tuple[tuple[str, float], ...]


def planner_numbers(controller: Any) -> Numbers:
    """Return the planner settings that the user can change."""
    if not isinstance(controller, Planner):
        return ()
    settings = ((name, getattr(controller.config, name)) for name in _SETTINGS)
    return tuple((name, value) for name, value in settings if isinstance(value, int | float))


def task_numbers(env: Env) -> Numbers:
    """Return the task's float parameters, including the weights of reward terms."""
    params = [(name, value) for name, value in env.task.params.items() if isinstance(value, float)]
    return tuple((name, value) for name, value in params if name not in ("dt", "substep_dt"))


def nominal_fields(env: Env) -> dict[str, np.ndarray]:
    """Return the nominal values of the fields that a task draws and that cannot be negative, such as masses.

    Fields whose nominal values depend on a world's object are left out.
    """
    model, drawn = env.task.model, [field.name for field in env.task.dynamics if field.rows is None]
    values = {name: np.ravel(getattr(owner_of(model, name), name)) for name in drawn}
    return {name: value for name, value in values.items() if (value >= 0).all() and value.any()}


def rebuilt_planner(planner: Planner, name: str, value: float) -> Planner:
    """Make a planner with a new value of a setting, because an existing planner's CUDA graphs contain the old value."""
    kind = type(getattr(planner.config, name))
    env = planner.env
    options = {key: value for key, value in env.options.given().items() if key not in _OF_THE_PLANNER}
    return type(planner)(
        env.task.definition, dataclasses.replace(planner.config, **{name: kind(value)}), value=planner.value,
        seed=planner.seeds[0], params=env.given_params, **(options | {"model": env.task.spec}),
    )  # fmt: skip
