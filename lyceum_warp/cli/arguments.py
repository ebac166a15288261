"""Arguments that several commands share: flags made from options, and values as NAME=VALUE."""

import ast
import dataclasses
import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from lyceum_warp.options import OPTIONS, EnvOptions, PhysicsOptions
from lyceum_warp.support.docstrings import attribute_docs

Repeated = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME=VALUE")]
"""A flag that may be given several times, each time with one NAME=VALUE."""

CameraWords = Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME|PART=VALUE")]
"""The flag --camera; ``viz.cameras.parsed_camera`` reads it."""

Class = TypeVar("Class")


@typing.dataclass_transform(kw_only_default=True, frozen_default=True)
def optional_flags(
    *options: type, omit: Collection[str] = (), default: str | Callable[[str], str] | None = None
) -> Callable[[type[Class]], type[Class]]:
    """Class decorator: add the fields of dataclasses as flags, with their docstrings as help texts.

    The class itself declares the fields that need another type or another help text in a shell. It must declare those
    of more than one type. Values are checked when the dataclass is made of them, not before: the parser would print an
    error as several lines in a box.

    Args:
        options: The dataclasses. A field of several of them has the type and the help text of the first.
        omit: Fields that get no flag.
        default: The default of a flag as its help text describes it, or a function that gives it for the name of a
            field. Flags that are not given then are None. Without this text all flags have the defaults of the
            dataclass.
    """

    def decorated(cls: type[Class]) -> type[Class]:
        own = dict(vars(cls).get("__annotations__", {}))
        inherited = getattr(cls, "__dataclass_fields__", {})
        flags: dict[str, Any] = {}
        for kind in options:
            hints, docs = typing.get_type_hints(kind), attribute_docs(kind) | attribute_docs(cls)
            for field in dataclasses.fields(kind):
                name = field.name
                if name in omit or name in flags or (name in inherited and name not in own):
                    continue
                if name not in vars(cls):
                    setattr(cls, name, field.default if default is None else None)
                value = getattr(cls, name)
                flag = own.pop(name, None) or (_optional(hints[name]) if value is None else hints[name])
                # a docstring says what None stands for
                text = default(name) if callable(default) else default or ""
                help_text, hint = " ".join(docs.get(name, "").split()), text if value is None else None
                flags[name] = Annotated[flag, tyro.conf.arg(help=help_text, help_behavior_hint=hint)]
        cls.__annotations__ = flags | own
        return dataclasses.dataclass(frozen=True, kw_only=True)(cls)

    return decorated


def _optional(hint: Any) -> Any:
    """The annotation of a flag that may be left out, for a field of one type, or of one type and None."""
    (kind,) = [kind for kind in typing.get_args(hint) if kind is not type(None)] if _is_union(hint) else [hint]
    return Annotated[kind | None, tyro.conf.DisallowNone]


def _is_union(hint: Any) -> bool:
    return typing.get_origin(hint) in (typing.Union, types.UnionType)


def given(flags: Any) -> dict[str, Any]:
    """The flags that differ from their defaults, by name."""
    fields = flags.__dataclass_fields__
    return {name: value for name, value in vars(flags).items() if value != fields[name].default}


NO_FLAGS = ("nworld", "seed", "first_world", "autoreset", "graphs", "nvtx", "model", "fields", "dynamics", "physics")
"""Options of an environment that do not become flags automatically: commands define nworld, seed and the model in their
own way, Physics has the flags of ``physics``, and the others are for programs in Python."""


@optional_flags(EnvOptions, omit=(*NO_FLAGS, "horizon"))
class Placement:
    """Where the worlds run."""

    engine: str = "auto"
    """mujoco (the C engine, on CPU cores), warp, or auto: warp on a CUDA device and mujoco on the CPU."""
    device: str = "cpu"
    """cpu, or a CUDA device such as cuda:0."""


@optional_flags(PhysicsOptions, default="")
class Physics:
    """How the worlds are simulated. Options that are left out are those of the task or of its model."""

    solver: Repeated = ()
    """Another limit of the constraint solver than the model's, as iterations=4, ls_iterations=10 or
    noslip_iterations=0; may be given several times."""

    def given(self) -> dict[str, Any]:
        """The options that the flags stand for, by name.

        Raises:
            ValueError: A limit is written in another way.
        """
        limits = {"solver": dict(map(parameter, self.solver))} if self.solver else {}
        return given(self) | limits

    def options(self) -> PhysicsOptions:
        """The same, checked.

        Raises:
            ValueError: A value is not valid.
        """
        return PhysicsOptions(**self.given())


def parameters(texts: Iterable[str], command: Any, *, instead: Mapping[str, str] | None = None) -> dict[str, Any]:
    """The parameters of a task from the texts of a repeated flag, each NAME=VALUE.

    Args:
        texts: The texts.
        command: The command's arguments: their flags are named where a text sets an option.
        instead: The flags of options that the command calls by another name.

    Raises:
        ValueError: A text is written in another way, or sets an option.
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
    """Name and value of a parameter of a task, or of a limit of the solver, from NAME=VALUE or NAME=0.7,inf.

    The path of a ``.npy`` file, which holds a table, becomes absolute.

    Raises:
        ValueError: The text is written in another way.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ValueError(f"{text!r} must be written as NAME=VALUE")
    if value.strip().endswith(".npy"):
        return name.strip(), str(Path(value.strip()).expanduser().resolve())
    parts = [_value(part, text) for part in value.strip().strip("[]()").split(",") if part.strip()]
    if not parts:
        raise ValueError(f"{text!r} must be written as NAME=VALUE")
    return name.strip(), parts[0] if len(parts) == 1 else parts


def _value(part: str, text: str) -> bool | int | float:
    part = part.strip()
    if part.lower() in ("true", "false"):
        return part.lower() == "true"
    try:
        value = ast.literal_eval(part)
        return value if isinstance(value, (bool, int)) else float(part)
    except (ValueError, SyntaxError, TypeError):
        pass
    try:
        return float(part)  # inf
    except ValueError:
        raise ValueError(f"the value in {text!r} must be a number, true or false") from None
