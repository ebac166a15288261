"""Shapes, parts and bounds of what an environment takes and gives."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import torch


@dataclasses.dataclass(frozen=True)
class Space:
    """One world's vector: its parts by name, its type, and its bounds where there are any.

    A scalar has no axis. The arrays of an environment have one more axis in front, the worlds.
    """

    parts: Mapping[str, slice] = dataclasses.field(default_factory=dict)
    """Where each named part lies, in order."""
    dtype: torch.dtype = torch.float32
    low: np.ndarray | None = None
    """Lower bounds, of ``shape``, or None."""
    high: np.ndarray | None = None
    """Upper bounds, of ``shape``, or None."""

    @classmethod
    def of(cls, sizes: Mapping[str, int], **rest: object) -> "Space":
        """A space from the sizes of its parts."""
        parts, start = {}, 0
        for name, size in sizes.items():
            parts[name] = slice(start, start + size)
            start += size
        return cls(parts, **rest)  # type: ignore[arg-type]

    @property
    def size(self) -> int:
        """Numbers in the vector; 1 for a scalar."""
        return max((part.stop for part in self.parts.values()), default=1)

    @property
    def shape(self) -> tuple[int, ...]:
        """(size,), or () for a scalar."""
        return (self.size,) if self.parts else ()

    def split(self, values: torch.Tensor) -> dict[str, torch.Tensor]:
        """Views of the parts of (..., size) values, by name."""
        return {name: values[..., part] for name, part in self.parts.items()}
