"""Check that the fields of a configuration match their annotations and bounds."""

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

    The function checks numbers with bounds, bools, ``Literal``, widths of hidden layers (``tuple[int, ...]``) and names
    of observation groups (``str | None``). The bounds of a number are a minimum, or a minimum and a maximum.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """
    for field in dataclasses.fields(config):
        name, value = field.name, getattr(config, field.name)
        kinds = (field.type, *typing.get_args(field.type))
        words = [word for kind in kinds if typing.get_origin(kind) is Literal for word in typing.get_args(kind)]
        if value is None and types.NoneType in kinds:
            continue
        if bool in kinds:
            check_flag(name, value)
        elif tuple[int, ...] in kinds:
            value = tuple(layer_sizes(value, name))
        elif field.type == str | None:
            if not isinstance(value, str):
                raise ValueError(f"{name} must be the name of a group of observations, not {value!r}")
        elif name in bounds:
            bound = bounds[name]
            low, high = bound if isinstance(bound, tuple) else (bound, math.inf)
            if int in kinds:
                limit = {} if high == math.inf else {"high": int(high)}
                value = whole_number(name, value, low=int(low), **limit)
            else:
                value = finite_number(name, value, low=low, high=high)
        elif words and not isinstance(value, tuple(kind for kind in kinds if isinstance(kind, type))):
            check_word(name, value, words)
        object.__setattr__(config, name, value)
