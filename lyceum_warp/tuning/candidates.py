"""List the physics settings to try for a task, and write a setting as flags or as Python."""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

from lyceum_warp.core import CONES, INTEGRATORS, JACOBIANS
from lyceum_warp.env import Env

_ITERATIONS = (4, 2, 1)
_LS_ITERATIONS = (10, 5)
_COARSE = ("implicitfast", "discrete")
"""Integrators that stay stable in long substeps."""

_AUTO_SPARSE = {"mujoco": 60, "warp": 33}
"""Smallest number of degrees of freedom for which each engine uses a sparse Jacobian."""
_DENSE_LIMIT = 60
"""Largest number of degrees of freedom for which MuJoCo Warp supports a dense Jacobian."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """Physics options to try together."""

    name: str
    group: str
    """A combination has at most one setting per group."""
    physics: Mapping[str, Any]
    """Options that differ from the task's, by their names in ``lw.PhysicsOptions``."""
    parts: tuple["Setting", ...] = ()


def candidates(env: Env) -> list[Setting]:
    """List the settings to try one by one."""
    option, limits = env.task.model.opt, env.options.physics.solver or {}
    cone, integrator = _name(CONES, option.cone), _name(INTEGRATORS, option.integrator)
    settings = [
        Setting(f"{name}={limit}", name, {"solver": {**limits, name: limit}})
        for name, lower_limits in (("iterations", _ITERATIONS), ("ls_iterations", _LS_ITERATIONS))
        for limit in lower_limits
        if limit < getattr(option, name)
    ]
    if option.noslip_iterations:
        settings.append(Setting("noslip_iterations=0", "noslip", {"solver": {**limits, "noslip_iterations": 0}}))
    settings += [Setting(f"cone {name}", "cone", {"cone": name}) for name in CONES if name != cone]
    integrators = [name for name in ("euler", *_COARSE) if name != integrator]
    settings += [Setting(name, "integrator", {"integrator": name}) for name in integrators]
    for substeps in _fewer(env.task.frame_skip):
        timestep = float(f"{env.timestep / substeps:.10g}")
        physics = {"frame_skip": substeps, "timestep": timestep}
        name = f"{substeps} x {1e3 * timestep:.4g} ms"
        settings.append(Setting(name, "substeps", physics))
        for coarse in _COARSE:
            if integrator != coarse:
                settings.append(Setting(f"{name}, {coarse}", "substeps", {**physics, "integrator": coarse}))
    settings += [Setting(f"jacobian {name}", "jacobian", {"jacobian": name}) for name in _other_jacobian(env)]
    if cone == "elliptic" and option.impratio != 1.0:
        settings.append(Setting("impratio=1", "impratio", {"impratio": 1.0}))
    if (nconmax := getattr(env.engine, "nconmax", None)) is not None:
        halves = {"nconmax": max(1, nconmax // 2), "njmax": max(1, env.engine.njmax // 2)}  # type: ignore[attr-defined]
        settings.append(Setting("half the contacts and constraints", "room", halves))
    return settings


def combined(settings: Iterable[Setting]) -> Setting | None:
    """Combine settings, or return None if the result equals one of them.

    A setting is left out if an earlier one has the same group or sets the same option.
    """
    parts: list[Setting] = []
    physics: dict[str, Any] = {}
    for setting in settings:
        limits = {**setting.physics.get("solver", {}), **physics.get("solver", {})}
        options = {name: value for name, value in setting.physics.items() if name != "solver"}
        if not options.keys() & physics.keys() and setting.group not in [part.group for part in parts]:
            parts.append(setting)
            physics |= options | ({"solver": limits} if limits else {})
    name = "; ".join(part.name for part in parts)
    return Setting(name, "combination", physics, tuple(parts)) if len(parts) > 1 else None


def flags(physics: Mapping[str, Any]) -> str:
    """Write a setting as command-line flags."""
    parts = [f"--solver {name}={limit}" for name, limit in physics.get("solver", {}).items()]
    parts += [f"--{name.replace('_', '-')} {value}" for name, value in physics.items() if name != "solver"]
    return " ".join(parts)


def task_line(physics: Mapping[str, Any]) -> str:
    """Write a setting as Python code for a task: the attribute ``physics`` with one entry, "fast"."""
    arguments = ", ".join(f"{name}={value!r}" for name, value in physics.items()).replace("'", '"')
    return f'physics = {{"fast": lw.PhysicsOptions({arguments})}}'


def _name(names: Mapping[str, Any], value: int) -> str | None:
    return next((name for name, number in names.items() if int(number) == int(value)), None)


def _fewer(substeps: int) -> list[int]:
    numbers = []
    while substeps > 1:
        substeps = (substeps + 1) // 2
        numbers.append(substeps)
    return numbers


def _other_jacobian(env: Env) -> list[str]:
    """Return the other form of the Jacobian, dense or sparse, if the engine supports it."""
    nv, engine = env.task.model.nv, env.engine.name
    jacobian = _name(JACOBIANS, env.task.model.opt.jacobian)
    if jacobian == "auto":
        jacobian = "sparse" if nv >= _AUTO_SPARSE.get(engine, 60) else "dense"
    other = "dense" if jacobian == "sparse" else "sparse"
    return [] if engine == "warp" and other == "dense" and nv > _DENSE_LIMIT else [other]
