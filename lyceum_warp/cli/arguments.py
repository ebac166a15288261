"""Define the flags that several commands share, and parse NAME=VALUE arguments."""

import contextlib
import dataclasses
import os
import re
import typing
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import tyro

from lyceum_warp import viz
from lyceum_warp.core import OPTIONS, Camera, EnvOptions, PhysicsOptions, given_values
from lyceum_warp.support.docstrings import attribute_docs

Repeated = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE")]

ParamWords = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(
        metavar="NAME=VALUE",
        help="A parameter of the task. Write a vector as NAME=0.7,inf and a table as NAME=[[1,2],[3,4]] or "
        "NAME=file.npy. The flag may be repeated.",
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

    The field's docstring becomes the flag's help text. If a flag needs another type or help text than its field, the
    subclass declares this flag. Flags default to None or (). Values are validated later, because the parser would print
    errors in a multi-line box.

    Args:
        options: The dataclasses. If several have the same field, the first one is used.
        omit: Names of fields without a flag.
        defaults: The texts that the help shows as default values, by the names of the flags.
    """

    def __init_subclass__(
        cls, *, options: Sequence[type], omit: Collection[str] = (), defaults: Mapping[str, str] = MappingProxyType({})
    ) -> None:
        declared: dict[str, Any] = vars(cls).get("__annotations__", {})
        types: dict[str, Any] = {}
        docs = attribute_docs(cls)
        for kind in options:
            types |= {name: hint for name, hint in typing.get_type_hints(kind).items() if name not in types}
            docs = attribute_docs(*filter(dataclasses.is_dataclass, reversed(kind.__mro__))) | docs
        cls.__annotations__ = {}
        for name, hint in (types | declared).items():
            if name in omit:
                continue
            default = vars(cls).get(name)
            setattr(cls, name, default)
            kinds = (hint, *typing.get_args(hint))
            choices = [word for kind in kinds if typing.get_origin(kind) is Literal for word in typing.get_args(kind)]
            flag = hint if name in declared else (str if choices else hint) | None
            text = tyro.conf.arg(
                metavar="|".join(choices) or None,
                help=" ".join(docs.get(name, "").split()),
                help_behavior_hint=defaults.get(name, "") if default is None else None,
            )
            cls.__annotations__[name] = Annotated[flag, text]
        dataclasses.dataclass(frozen=True, kw_only=True)(cls)


def given(flags: Any) -> dict[str, Any]:
    """Return the values that differ from the defaults, by the names of their flags."""
    values = given_values(flags)
    if "solver" in values:
        values["solver"] = dict(map(parameter, values["solver"]))
    if isinstance(values.get("objects"), str):
        values["objects"] = values["objects"].split(",")
    if isinstance(values.get("cameras"), str):
        values["cameras"] = cameras(values["cameras"])
    return values


NO_FLAGS = (
    "nworld", "seed", "first_world", "autoreset", "graphs", "model", "fields", "dynamics", "final_pictures", "physics",
)  # fmt: skip
"""Options of an environment for which no flag is generated.

Each command declares its own flags for nworld, seed and the model. ``Physics`` declares the physics options. The other
options can be set only in Python.
"""


class Placement(OptionFlags, options=[EnvOptions], omit=(*NO_FLAGS, "horizon")):
    """Where the worlds run."""

    engine: str | None = None
    """mujoco (the C engine, on CPU cores), warp, or auto (the default): warp on a CUDA device and mujoco on the CPU."""
    device: str | None = None
    """cpu (the default), or a CUDA device such as cuda:0. The commands eval and view use the CPU by default if a run's
    engine is auto, because the CPU is faster for a few worlds."""
    objects: Annotated[str | None, tyro.conf.arg(metavar="NAME,NAME...")] = None
    """Names of the objects that the worlds hold, of those that the task declares. By default, the worlds hold all of
    them, or the geoms of the model."""
    cameras: Annotated[str | None, tyro.conf.arg(metavar="NAME:WxH:KIND,...")] = None
    """Cameras of the model whose pictures are observations, such as side or side:64x64,top:84x84:depth; each kind is
    rgb (the default), depth or segmentation. The group of observations is "camera", or with several cameras the name,
    and _KIND unless it is rgb: side,top_depth. By default, the cameras are those of the run or the task; "" means
    none."""


class EnvFlags(
    Placement,
    options=[EnvOptions],
    omit=(*NO_FLAGS, "engine", "device", "nthread", "fitted", "fitted_draws", "objects", "cameras"),
):
    """Where the worlds run, and the length of their episodes. The defaults come from the run, if there is one."""


class Physics(OptionFlags, options=[PhysicsOptions], omit=["base"]):
    """Physics options of the worlds. The defaults come from the run, the task or its model."""

    physics: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """The name of a set of physics options that the task defines (see lyceum-warp tasks), or exact for the task's
    default physics. A flag for a single option, such as --integrator, overrides this option of the set.
    """
    solver: Repeated = ()
    """A limit of the constraint solver, such as iterations=4, ls_iterations=10 or noslip_iterations=0; may be repeated.
    The default limits come from the model."""


def parameters(texts: Iterable[str]) -> dict[str, Any]:
    """Parse a task's parameters. Each text has the form NAME=VALUE."""
    values = dict(map(parameter, texts))
    if options := values.keys() & set(OPTIONS):
        name = min(options)
        raise ValueError(f"{name} is an option, not a parameter of the task: --help-all describes the options' flags")
    return values


def parameter(text: str) -> tuple[str, Any]:
    """Parse a task parameter or a solver limit, such as NAME=VALUE, NAME=0.7,inf or NAME=[[1,2],[3,4]]."""
    name, _, value = map(str.strip, text.partition("="))
    parts = [part for part in value.strip("[]()").split(",") if part.strip()]
    if not name or not parts:
        raise ValueError(f"{text!r} must be written as NAME=VALUE")
    if value.endswith(".npy"):
        return name, str(Path(os.path.expanduser(value)).resolve())
    if table := re.fullmatch(r"\[\[(.+)\]\]", value):
        return name, [[_value(part, text) for part in row.split(",")] for row in re.split(r"\]\s*,\s*\[", table[1])]
    values = [_value(part, text) for part in parts]
    return name, values[0] if len(values) == 1 else values


def video_camera(arguments: Sequence[str]) -> "str | viz.FreeCamera | None":
    """Parse the camera of a video: nothing, a name, an index, or parts of a free camera's pose as NAME=VALUE."""
    if len(arguments) < 2 and "=" not in "".join(arguments):
        return arguments[0] if arguments else None
    pose: dict[str, Any] = {}
    for argument in arguments:
        name, _, value = argument.partition("=")
        if name not in viz.FreeCamera.__dataclass_fields__:
            parts = ", ".join(f"{part}=..." for part in viz.FreeCamera.__dataclass_fields__)
            raise ValueError(f"a camera is a name, an index, or a pose of {parts}, not {argument!r}")
        pose[name] = value if name == "track" else parameter(argument)[1]
    return viz.FreeCamera(**pose)


_CAMERA = re.compile(r"([^:]+)(?::(\d+)x(\d+))?(?::([a-z]+))?")


def cameras(text: str) -> tuple[Camera, ...]:
    """Parse cameras, such as side:64x64,top:84x84:depth. An empty text means no cameras."""
    entries = text.split(",") if text else []
    parsed: list[Camera] = []
    for entry in entries:
        if (match := _CAMERA.fullmatch(entry)) is None:
            raise ValueError(f"a camera must be written as NAME, NAME:64x64 or NAME:64x64:depth, not {entry!r}")
        name, width, height, kind = match.groups()
        group = "camera" if len(entries) == 1 else name if kind in (None, "rgb") else f"{name}_{kind}"
        values: dict[str, Any] = {"width": width and int(width), "height": height and int(height), "kind": kind}
        parsed.append(Camera(name, group=group, **{key: value for key, value in values.items() if value is not None}))
    return tuple(parsed)


def _value(part: str, text: str) -> bool | int | float:
    part = part.strip()
    if part.lower() in ("true", "false"):
        return part.lower() == "true"
    for number in (int, float):
        with contextlib.suppress(ValueError):
            return number(part)
    raise ValueError(f"the value in {text!r} must be a number, true or false")
