"""Check the fields of a configuration by their annotations and bounds."""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal

from lyceum_warp.support.validate import check_flag, check_word, finite_number, layer_sizes, whole_number

LEAST = -math.inf
"""Lower bound that admits every finite number."""


def check_fields(config: Any, bounds: Mapping[str, float | tuple[float, float]]) -> None:
    """Check the fields of a frozen dataclass, and convert numbers to their annotated types.

    A field is a number, a bool, a ``Literal``, the widths of hidden layers (``tuple[int, ...]``) or the name of a group
    of observations (``str | None``). The bounds of a number are a minimum, or a minimum and a maximum.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """
    for field in dataclasses.fields(config):
        name, kind, value = field.name, field.type, getattr(config, field.name)
        arguments = typing.get_args(kind)
        if value is None and types.NoneType in arguments:
            continue
        if kind is bool:
            check_flag(name, value)
        elif words := [word for one in (kind, *arguments) if typing.get_origin(one) is Literal
                       for word in typing.get_args(one)]:  # fmt: skip
            check_word(name, value, words)
        elif tuple[int, ...] in (kind, *arguments):
            value = tuple(layer_sizes(value, name))
        elif str in arguments:
            if not isinstance(value, str):
                raise ValueError(f"{name} must be the name of a group of observations, not {value!r}")
        elif name in bounds:
            bound = bounds[name]
            low, high = bound if isinstance(bound, tuple) else (bound, math.inf)
            if int in (kind, *arguments):
                value = whole_number(name, value, low=int(low))
            else:
                value = finite_number(name, value, low=low, high=high)
        object.__setattr__(config, name, value)
