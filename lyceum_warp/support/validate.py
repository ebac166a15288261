"""Check values that users pass."""

import contextlib
import dataclasses
import math
import numbers
import sys
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypeAlias

Rule: TypeAlias = float | tuple[float, float] | str | list[str]
"""What a field must be besides its type: a number with a minimum, or with a minimum and a maximum, or one of the words
in a list. A text describes strings."""


def whole_number(name: str, value: Any, *, low: int, high: int = 2**31 - 1) -> int:
    """Convert a number of any type to an int within bounds."""
    try:
        number = int(value)
        fits = number == value and low <= number <= high and not isinstance(value, bool)
    except (TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        raise ValueError(f"{name} must be a whole number from {low} to {high}, not {value!r}")
    return number


def positive_number(name: str, value: Any, unit: str) -> float:
    """Convert a positive, finite number to a float."""
    if not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise ValueError(f"{name} must be a positive number of {unit}, not {value!r}")
    return float(value)


def check_kind(name: str, value: Any, kind: Any, example: str) -> None:
    """Check the type of a value."""
    if not isinstance(value, kind):
        wanted = getattr(kind, "__name__", str(kind).rpartition(".")[2])
        raise ValueError(f"{name} must be of type {wanted}, {example}, not {described(value)}")


def check_flag(name: str, value: Any) -> None:
    """Check that a value is True or False."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be True or False, not {value!r}")


def check_word(name: str, value: Any, choices: Sequence[str], others: str = "") -> None:
    """Check that a value is one of the given words."""
    if not isinstance(value, str) or value not in choices:
        *first, last = map(repr, choices)
        raise ValueError(f"{name} must be {', '.join(first)} or {last}{others}, not {value!r}")


def check_group(group: Any, groups: Iterable[str], task: str) -> None:
    """Check that a task has a group of observations."""
    if group not in (choices := list(groups)):
        raise ValueError(f"the task {task!r} has no group {group!r} of observations: it has {', '.join(choices)}")


def layer_sizes(hidden: Any, name: str = "hidden") -> list[int]:
    """Check that the widths of hidden layers are positive whole numbers."""
    try:
        return [whole_number("a width", width, low=1) for width in hidden]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be the widths of the hidden layers, as in (64, 64), not {hidden!r}") from error


def described(value: Any) -> str:
    """Describe a value in a few words, for error messages."""
    torch: Any = sys.modules.get("torch")  # until torch is loaded, no value is a tensor or a network
    if torch and isinstance(value, torch.Tensor):
        return f"a {str(value.dtype).removeprefix('torch.')} tensor of shape {tuple(value.shape)}"
    if torch and isinstance(value, torch.nn.Module):
        return type(value).__name__
    if hasattr(value, "shape"):
        return f"a {type(value).__name__} of shape {tuple(value.shape)}"
    return f"{type(value).__name__} {value!r}"


def first_sentence(error: BaseException) -> str:
    """Get the first sentence of an error message; torch's whole messages can fill a page."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].split(". ")[0][:200]


def finite_number(name: str, value: Any, *, low: float = -math.inf, high: float = math.inf) -> float:
    """Convert a finite number of any type to a float within bounds."""
    if not isinstance(value, bool) and isinstance(value, numbers.Real):
        with contextlib.suppress(OverflowError):  # float(10**400)
            number = float(value)
            if math.isfinite(number) and low <= number <= high:
                return number
    bounds = f" from {low:g} to {high:g}" if high < math.inf else f" of at least {low:g}" if low > -math.inf else ""
    raise ValueError(f"{name} must be a finite number{bounds}, not {value!r}")


def check_fields(config: Any, rules: Mapping[str, Rule]) -> None:
    """Check the fields of a frozen dataclass, and convert numbers to their annotated types.

    The function checks fields with rules, bools, ``Literal``, widths of hidden layers (``tuple[int, ...]``) and names
    of observation groups (``tuple[str, ...]``). None needs no check if the annotation allows it.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        kinds = (field.type, *typing.get_args(field.type))
        if value is not None or types.NoneType not in kinds:
            object.__setattr__(config, field.name, _checked(field.name, value, kinds, rules.get(field.name)))


def _checked(name: str, value: Any, kinds: tuple[Any, ...], rule: Rule | None) -> Any:
    if isinstance(rule, int | float | tuple):
        low, high = rule if isinstance(rule, tuple) else (rule, math.inf)
        if int in kinds:
            return whole_number(name, value, low=int(low), high=int(min(high, 2**31 - 1)))
        return finite_number(name, value, low=low, high=high)
    if tuple[int, ...] in kinds:
        return tuple(layer_sizes(value, name))
    if tuple[str, ...] in kinds:
        if not isinstance(value, list | tuple) or not all(isinstance(word, str) for word in value):
            raise ValueError(f"{name} must be names of groups of observations, as in ('camera',), not {value!r}")
        return tuple(value)
    if bool in kinds:
        check_flag(name, value)
    if isinstance(rule, str):
        check_kind(name, value, str, rule)
    choices = [choice for kind in kinds if typing.get_origin(kind) is Literal for choice in typing.get_args(kind)]
    choices += rule if isinstance(rule, list) else []
    if choices and not isinstance(value, tuple(kind for kind in kinds if isinstance(kind, type) and kind is not str)):
        check_word(name, value, choices)
    return value
