"""Declare how observations, actions and states change if left and right are exchanged."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Reflection = tuple[Sequence[int], Sequence[float]]
"""Order and signs of columns: the mirror image of a row is ``signs * row[order]``."""


@dataclasses.dataclass(frozen=True)
class Mirror:
    """A task's left-right mirror image, for ``lw.Task.mirror``.

    In observations, actions and states, each reflection applies to the parts with its name. A reflection that keeps the
    order of columns is a list of signs: ``"command": (1, -1, -1)`` inverts the lateral velocity and the yaw rate. Any
    other reflection is a pair of lists: the new order of the columns, and the signs. For example, ``"foot_force":
    ([1, 0], [1, 1])`` exchanges the left and the right foot. In the base's axes, velocities have the signs (1, -1, 1),
    and angular velocities have the signs (-1, 1, -1). If actions are controls, one reflection named "action" applies to
    the whole action.

    Args:
        parts: The reflection of each part, by the part's name.

    Raises:
        ValueError: A reflection is not its own inverse.
    """

    parts: Mapping[str, Any]

    def __post_init__(self) -> None:
        """Add the order to reflections that list only signs, and check all reflections."""
        parts = {name: _complete(part) for name, part in self.parts.items()}
        for name, (order, signs) in parts.items():
            places, factors = np.asarray(order), np.asarray(signs)
            fits = sorted(order) == list(range(len(signs))) and set(np.abs(factors)) <= {1.0}
            if not fits or (places[places] != range(len(order))).any() or (factors * factors[places] != 1.0).any():
                raise ValueError(
                    f"the reflection {name!r} of lw.Mirror must be its own inverse, such as ([1, 0], [-1, -1]), not "
                    f"{self.parts[name]!r}"
                )
        object.__setattr__(self, "parts", parts)

    def columns(self, parts: Mapping[str, slice], *, task: str, whole: str | None = None) -> Reflection:
        """Combine the reflections of all parts into one reflection of an observation, an action or a state."""
        if whole is not None and whole in self.parts:
            parts = {whole: slice(0, max(part.stop for part in parts.values()))}
        order, signs = list[int](), list[float]()
        for name, part in parts.items():
            size = part.stop - part.start
            reflection = self.parts.get(name)
            if reflection is None or len(reflection[1]) != size:
                has = "no reflection" if reflection is None else f"a reflection of {len(reflection[1])} columns"
                raise ValueError(f"the mirror of the task {task!r} has {has} for {name!r}, which has {size} columns")
            order += [part.start + int(place) for place in reflection[0]]
            signs += map(float, reflection[1])
        return order, signs


def _complete(part: Any) -> Reflection:
    order, signs = (range(len(part)), part) if np.ndim(part[0]) == 0 else part
    return [*map(int, order)], [*map(float, signs)]
