"""Compute the layout of memory and observations: each field of a struct is a named slice of a row of floats."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from lyceum_warp.binding.sources import is_row
from lyceum_warp.core.task import Part
from lyceum_warp.support.validate import whole_number


@dataclasses.dataclass(frozen=True)
class Slice:
    """Locates one part in a row of floats."""

    start: int
    count: int
    dtype: Any
    """The type of an element: float, or a vector or matrix of float."""

    @property
    def size(self) -> int:
        """Number of floats."""
        return self.count * int(np.prod(getattr(self.dtype, "_shape_", ()), dtype=int))


Layout = dict[str, Slice]
"""Maps the name of each part to its slice of a row of floats."""


def parts_of(struct: Any, owner: str) -> dict[str, Part]:
    """Return the parts that a struct declares, by field name. ``owner`` is the struct's name in error messages."""
    attributes = {name: getattr(struct.cls, name, None) for name in struct.vars}
    parts = {name: part for name, part in attributes.items() if isinstance(part, Part)}
    for name in parts:
        kind = struct.vars[name].type
        if not is_row(kind) or kind.ndim != 1 or getattr(kind.dtype, "_wp_scalar_type_", kind.dtype) is not wp.float32:
            raise ValueError(
                f"{owner}.{name} has a size, so it must be a row of floats or of float vectors: declare it as "
                f"{name}: Row[float]"
            )
    return parts


def layout(struct: Any, kind: str, params: Mapping[str, Any], owner: str) -> Layout:
    """Compute the layout of those parts of a struct that have the given kind.

    A part's size may be the name of a table in ``params``.
    """
    slices, start = dict[str, Slice](), 0
    for name, part in parts_of(struct, owner).items():
        if part.kind == kind:
            count = length(f"the size of {owner}.{name}", part.size, params)
            slices[name] = Slice(start, count, struct.vars[name].type.dtype)
            start += slices[name].size
    return slices


def sizes(layout: Layout) -> dict[str, int]:
    """Return the number of floats in each part."""
    return {name: part.size for name, part in layout.items()}


def view_lines(layout: Layout, struct: str, row: str, scope: dict[str, Any]) -> list[str]:
    """Generate Warp source that sets a struct's fields to slices of a row. Add the fields' types to ``scope``."""
    lines = []
    for name, part in layout.items():
        scope[f"dtype_{struct}_{name}"] = part.dtype
        # a pointer with a constant size compiles to faster code than a slice
        pointer = f"{row}.ptr + wp.uint64({4 * part.start})"
        lines.append(f"{struct}.{name} = wp.array(ptr={pointer}, shape=({part.count},), dtype=dtype_{struct}_{name})")
    return lines


def length(what: str, size: int | str, params: Mapping[str, Any]) -> int:
    """Resolve a declared size, which is a number or a table's name. A name becomes the table's number of rows."""
    if not isinstance(size, str):
        return whole_number(what, size, low=1)
    table = params.get(size)
    if not isinstance(table, list | tuple | np.ndarray):
        raise ValueError(f"{what} is {size!r}, which is not a table in Params: give a number, or a table's name")
    return len(table)
