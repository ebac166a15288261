"""Define the flags that several commands share, and parse NAME=VALUE arguments."""

import contextlib
import dataclasses
import os
import typing
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from lyceum_warp.core import OPTIONS, EnvOptions, PhysicsOptions, given_values
from lyceum_warp.support.docstrings import attribute_docs

Repeated = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE")]

ParamWords = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(
        metavar="NAME=VALUE",
        help="A parameter of the task. Write a vector as NAME=0.7,inf and a table as NAME=file.npy. The flag "
        "may be repeated.",
    ),
]

Trust = Annotated[
    bool,
    tyro.conf.arg(
        help="Trust a run that you did not make on this machine. From now on, commands may execute the run's task and "
        "read the files that the run names.",
    ),
]

CameraWords = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(
        metavar="NAME|PART=VALUE",
        help='Camera of videos: a camera of the model by name or index, "free" for MuJoCo\'s default free camera, or a '
        "part of a free camera's pose: azimuth=90, elevation=-20, distance=3, lookat=0,0,1 or track=BODY. The flag "
        "may be repeated.",
    ),
]

TaskWord = Annotated[
    tyro.conf.Positional[str],
    tyro.conf.arg(
        metavar="TASK",
        help="A task's name (see lyceum-warp tasks), or its file: path/to/file.py, or path/to/file.py:Class.",
    ),
]


@typing.dataclass_transform(kw_only_default=True, frozen_default=True)
class OptionFlags:
    """Base class for groups of flags. Each field of the ``options`` dataclasses becomes a flag.

    The field's docstring becomes the flag's help text. If a flag needs another type, default or help text than its
    field, the subclass declares this flag. Values are validated later, because the parser would print errors in a
    multi-line box.

    Args:
        options: The dataclasses. If several have the same field, the first one is used.
        omit: Names of fields without a flag.
        default: The text that the help shows as the default value. A string applies to all flags; a mapping contains
            a string for each field. The flags themselves default to None.
    """

    def __init_subclass__(
        cls, *, options: Sequence[type] = (), omit: Collection[str] = (), default: str | Mapping[str, str] | None = None
    ) -> None:
        if not options:  # this subclass only omits flags from the help
            return
        own = dict(vars(cls).get("__annotations__", {}))
        flags: dict[str, Any] = {}
        for kind in options:
            hints, docs = typing.get_type_hints(kind), attribute_docs(kind) | attribute_docs(cls)
            for field in dataclasses.fields(kind):
                name = field.name
                if name in omit or name in flags:
                    continue
                if name not in vars(cls):
                    setattr(cls, name, field.default if default is None else None)
                value = getattr(cls, name)
                flag = own.pop(name, None) or hints[name]
                if value is None and flag is hints[name]:  # the user may omit the flag, but cannot pass None
                    flag = Annotated[flag | None, tyro.conf.DisallowNone]
                text = default[name] if isinstance(default, Mapping) else default or ""
                help_text, hint = " ".join(docs.get(name, "").split()), text if value is None else None
                flags[name] = Annotated[flag, tyro.conf.arg(help=help_text, help_behavior_hint=hint)]
        cls.__annotations__ = flags | own
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)


def given(flags: Any) -> dict[str, Any]:
    """Return the values that differ from the defaults, by the names of their flags."""
    found = given_values(flags)
    if "solver" in found:
        found["solver"] = dict(map(parameter, found["solver"]))
    return found


NO_FLAGS = ("nworld", "seed", "first_world", "autoreset", "graphs", "model", "fields", "dynamics", "physics")
"""Options of an environment for which no flag is generated.

Each command declares its own flags for nworld, seed and the model. ``Physics`` declares the physics options. The other
options can be set only in Python.
"""


class Placement(OptionFlags, options=[EnvOptions], omit=(*NO_FLAGS, "horizon")):
    """Where the worlds run."""

    engine: str = "auto"
    """mujoco (the C engine, on CPU cores), warp, or auto: warp on a CUDA device and mujoco on the CPU."""
    device: str = "cpu"
    """cpu, or a CUDA device such as cuda:0."""


class EnvFlags(OptionFlags, options=[EnvOptions], omit=NO_FLAGS, default=""):
    """Where the worlds run, and the length of their episodes. The defaults come from the run, if there is one."""

    engine: Annotated[str | None, tyro.conf.arg(metavar="STR")] = None
    """mujoco (the C engine, on CPU cores), warp, or auto (the default): warp on a CUDA device and mujoco on the CPU."""
    device: Annotated[str | None, tyro.conf.arg(metavar="STR")] = None
    """cpu (the default), or a CUDA device such as cuda:0. If the run's engine is auto, the default is the CPU,
    which is faster than a GPU for a few worlds."""


class Physics(OptionFlags, options=[PhysicsOptions], omit=["base"], default=""):
    """Physics options of the worlds. The defaults come from the run, the task or its model."""

    physics: Annotated[str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint="")] = None
    """The name of a set of physics options that the task defines (see lyceum-warp tasks), or exact for the task's
    default physics. A flag for a single option, such as --integrator, overrides this option of the set.
    """
    solver: Repeated = ()
    """A limit of the constraint solver, such as iterations=4, ls_iterations=10 or noslip_iterations=0; may be repeated.
    The default limits come from the model."""


def parameters(texts: Iterable[str], command: Any, *, instead: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Parse a task's parameters. Each text has the form NAME=VALUE.

    If NAME is an option, the error names its flag. ``instead`` maps an option to its flag if their names differ.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name = text.partition("=")[0].strip()
        if name in OPTIONS:
            flags = {flag: f"--{flag.replace('_', '-')}" for flag in _flag_names(command)} | dict(instead or {})
            way = f"use {flags[name]}" if name in flags else "this command has no flag for it"
            raise ValueError(f"{name} is an option, not a parameter of the task: {way}")
        found.update([parameter(text)])
    return found


def _flag_names(command: Any) -> list[str]:
    nested = ([name] if not dataclasses.is_dataclass(v) else _flag_names(v) for name, v in vars(command).items())
    return [name for names in nested for name in names]


def parameter(text: str) -> tuple[str, Any]:
    """Parse a task parameter or a solver limit, such as NAME=VALUE or NAME=0.7,inf."""
    name, value = (part.strip() for part in text.partition("=")[::2])
    parts = [part for part in value.strip("[]()").split(",") if part.strip()]
    if not name or not parts:
        raise ValueError(f"{text!r} must be written as NAME=VALUE")
    if value.endswith(".npy"):
        return name, str(Path(os.path.expanduser(value)).resolve())
    values = [_value(part, text) for part in parts]
    return name, values[0] if len(values) == 1 else values


def _value(part: str, text: str) -> bool | int | float:
    part = part.strip()
    if part.lower() in ("true", "false"):
        return part.lower() == "true"
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(part)
    raise ValueError(f"the value in {text!r} must be a number, true or false")
