"""Change a setting for the duration of a ``with`` block."""

import contextlib
from collections.abc import Callable, Iterator
from typing import TypeVar

Value = TypeVar("Value")


@contextlib.contextmanager
def temporarily(put: Callable[[Value], object], value: Value, before: Value) -> Iterator[None]:
    """Put a value, and at the end of the context the value before."""
    put(value)
    try:
        yield
    finally:
        put(before)
