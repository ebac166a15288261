"""Checks of what a user gives that more than one room needs."""

from typing import Any


def whole_number(name: str, value: Any, *, low: int, high: int = 2**31 - 1) -> int:
    """A whole number within bounds, from whatever type of number it comes as.

    Raises:
        ValueError: It is none.
    """
    try:
        number = int(value)
        fits = number == value and low <= number <= high
    except (TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        raise ValueError(f"{name} has to be a whole number from {low} to {high}, not {value!r}")
    return number
