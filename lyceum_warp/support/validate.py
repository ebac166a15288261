"""Check values that users pass."""

import contextlib
import math
import numbers
import sys
from collections.abc import Iterable, Sequence
from typing import Any


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


def check_word(name: str, value: Any, words: Sequence[str], others: str = "") -> None:
    """Check that a value is one of the given words."""
    if not isinstance(value, str) or value not in words:
        *first, last = map(repr, words)
        raise ValueError(f"{name} must be {', '.join(first)} or {last}{others}, not {value!r}")


def check_group(group: Any, groups: Iterable[str], task: str) -> None:
    """Check that a task has a group of observations."""
    if group not in (known := list(groups)):
        raise ValueError(f"the task {task!r} has no group {group!r} of observations: it has {', '.join(known)}")


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
