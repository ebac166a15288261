"""Arguments that several commands share: flags made from options, and values as NAME=VALUE."""

import ast
import dataclasses
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from lyceum_warp.docstrings import attribute_docs
from lyceum_warp.options import PhysicsOptions

Words = tyro.conf.UseAppendAction[tuple[str, ...]]
"""A flag that may be given several times."""

Class = TypeVar("Class")


@typing.dataclass_transform(kw_only_default=True, frozen_default=True)
def optional_flags(options: type, *, default: str = "") -> Callable[[type[Class]], type[Class]]:
    """Class decorator: add the fields of a dataclass as flags, each None (or False) unless it is given.

    Help texts are the docstrings of the fields. The class declares those fields itself that a shell writes in another
    way, and those of more than one type. Values are checked when the dataclass is made of them, not before.

    Args:
        options: The dataclass.
        default: How the help text describes the default of a flag.
    """

    def decorated(cls: type[Class]) -> type[Class]:
        own = dict(vars(cls).get("__annotations__", {}))
        hints, docs = typing.get_type_hints(options), attribute_docs(options) | attribute_docs(cls)
        flags: dict[str, Any] = {}
        for field in dataclasses.fields(options):
            if field.name not in vars(cls):
                setattr(cls, field.name, False if field.default is False else None)
            flag = own.pop(field.name, None) or _optional(hints[field.name])
            hint = default if getattr(cls, field.name) is None else None
            text = " ".join(docs.get(field.name, "").split())
            flags[field.name] = Annotated[flag, tyro.conf.arg(help=text, help_behavior_hint=hint)]
        cls.__annotations__ = flags | own
        return dataclasses.dataclass(frozen=True, kw_only=True)(cls)

    return decorated


def _optional(hint: Any) -> Any:
    """The annotation of a flag that may be left out, for a field of one type, or of one type and None."""
    if hint is bool:
        return bool
    (kind,) = [kind for kind in typing.get_args(hint) if kind is not type(None)] or [hint]
    return Annotated[kind | None, tyro.conf.arg(metavar=kind.__name__.upper())]


@optional_flags(PhysicsOptions)
class Physics:
    """How the worlds are simulated. Options that are left out are those of the task or of its model."""

    solver: Annotated[Words, tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Another limit of the constraint solver than the model's, as iterations=4, ls_iterations=10 or
    noslip_iterations=0; may be given several times."""

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> "Physics":
        """The flags of a run's config.json; options that it does not name have their defaults."""
        saved = dict(config.get("physics", {}))
        solver = saved.pop("solver", None) or {}
        return cls(solver=tuple(f"{name}={limit}" for name, limit in solver.items()), **saved)

    def options(self) -> PhysicsOptions:
        """The options that the flags stand for.

        Raises:
            ValueError: A value is not valid.
        """
        return PhysicsOptions(**vars(self) | {"solver": dict(map(parameter, self.solver))})


def portable(task: str) -> str:
    """A task's file with its whole path, so that a run can be used from another folder; a name stays as it is."""
    path, colon, attribute = task.partition(":")
    return f"{Path(path).resolve()}{colon}{attribute}" if path.endswith(".py") else task


def parameter(text: str) -> tuple[str, Any]:
    """Name and value of a parameter of a task, or of a limit of the solver, from NAME=VALUE or NAME=0.7,inf.

    Raises:
        ValueError: The text is written in another way.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ValueError(f"{text!r} must be written as NAME=VALUE")
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


def spelled(value: Any) -> str:
    """A value as `parameter` reads it."""
    return ",".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
