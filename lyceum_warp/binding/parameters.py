"""The values of a task's parameters, the fields of its ``Params``: defaults, checks, and the array for the kernels."""

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.fields import elements, rows
from lyceum_warp.options import OPTIONS, suggestion
from lyceum_warp.task import Element

_FILLED_IN = ("dt", "substep_dt")
"""Fields of ``Params`` that follow from the model and the task."""


class Parameters:
    """Values for every field of a task's ``Params``: scalars and vectors, or arrays with one value a world.

    Args:
        struct: The task's ``Params``.
        task_name: The task's name, for messages.
        model: The compiled model, in which named elements are found.
        nworld: Number of worlds.
        timestep: Seconds in a step, the value of ``dt``.
        given: Values that differ from the defaults.

    Raises:
        ValueError: A field has the name of an option, a name is unknown, a value is missing or does not fit its field.
    """

    def __init__(
        self,
        struct: Any,
        task_name: str,
        model: mujoco.MjModel,
        *,
        nworld: int,
        timestep: float,
        given: Mapping[str, Any],
    ) -> None:
        self._struct, self._task_name, self._model, self._nworld = struct, task_name, model, nworld
        self._sizes: dict[str, int] = {}
        if taken := [name for name in struct.vars if name in (*OPTIONS, "task", "options")]:
            raise ValueError(
                f"the parameter {taken[0]!r} of the task {task_name!r} has the name of an option of make(), so that no "
                "value would reach it: rename it in Params"
            )
        self.values: dict[str, Any] = {}
        for name in struct.vars:
            # Warp's structs ignore defaults: they are read from the class behind the struct
            if name in _FILLED_IN:
                self.values[name] = timestep if name == "dt" else float(model.opt.timestep)
            elif hasattr(struct.cls, name):
                self.values[name] = getattr(struct.cls, name)
        self.values = self.checked(given)

    def checked(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """The values with some replaced, each converted to what its field holds.

        Raises:
            ValueError: A name is unknown, a value is missing or does not fit its field.
        """
        known = self._struct.vars
        for name in given:
            if name not in known or name in _FILLED_IN:
                names = sorted(set(known) - set(_FILLED_IN))
                if name in OPTIONS:
                    raise ValueError(
                        f"{name!r} is an option, not a parameter of the task {self._task_name!r}: make another "
                        f"environment, as env.replicate({name}=...)"
                    )
                hint = suggestion(name, names) or f"it has {', '.join(names) or 'none'}"
                raise ValueError(f"the task {self._task_name!r} has no parameter {name!r}: {hint}")
        if missing := [name for name in known if name not in self.values and name not in given]:
            raise ValueError(f"the task {self._task_name!r} needs values for {', '.join(missing)}")
        return {name: self._converted(name, value) for name, value in {**self.values, **given}.items()}

    def array(self, device: wp.Device) -> wp.array:
        """The values as the kernels read them: one entry, or one a world where any value differs."""
        differ = any(isinstance(value, np.ndarray) for value in self.values.values())
        instances = [self._instance(w) for w in range(self._nworld if differ else 1)]
        return wp.array(instances, dtype=self._struct, device=device)

    def _converted(self, name: str, value: Any) -> Any:
        """A value as its field holds it: a scalar or vector, or an array with one a world."""
        kind = self._struct.vars[name].type
        default = getattr(self._struct.cls, name, None)
        what = f"the parameter {name} of {self._task_name!r}"
        given = f"the parameter {name}={value!r} of {self._task_name!r}"
        if isinstance(value, Element):
            if not isinstance(default, Element) or default.field != value.field:
                is_what = f"one of {default.field!r}" if isinstance(default, Element) else "a number"
                raise ValueError(f"{what} can't be an element of {value.field!r}: it is {is_what}")
            if kind is not wp.int32:
                raise ValueError(f"{what} must be declared as int: it is an index")
            return elements(self._model, value.field, value.name).start
        if isinstance(default, Element) and isinstance(value, str):
            return elements(self._model, default.field, value).start
        shape = tuple(getattr(kind, "_shape_", ()))
        try:
            array = np.asarray(value, dtype=np.float64)  # Warp's own vectors, lists and tensors alike
        except (TypeError, ValueError) as error:
            raise ValueError(f"{given} is not a number: {error}") from error
        if np.isnan(array).any():
            raise ValueError(f"{given} is not a number")
        if isinstance(default, Element):
            self._check_index(given, array, default.field)
        if array.shape == shape:
            if shape:
                return kind(*array.ravel())
            if kind in (wp.bool, wp.int32) and not (array == np.round(array)).all():
                raise ValueError(f"{given} must be a whole number")
            return {wp.bool: bool, wp.int32: int}.get(kind, float)(array.item())
        per_world = (self._nworld, *shape)
        if array.shape == per_world:
            return array
        raise ValueError(
            f"{what} has shape {array.shape}; it takes {shape or 'one number'}, or one a world, {per_world}"
        )

    def _check_index(self, given: str, array: np.ndarray, field: str) -> None:
        if field not in self._sizes:
            self._sizes[field] = rows(self._model, field)
        count = self._sizes[field]
        if ((array < 0) | (array >= count)).any():
            raise ValueError(
                f"{given} is an index of {field!r}, of which the model has {count}: give one from 0 to {count - 1}, "
                "or a name"
            )

    def _instance(self, world: int) -> Any:
        instance = self._struct()
        for name, value in self.values.items():
            kind = self._struct.vars[name].type
            if isinstance(value, np.ndarray):
                value = kind(*value[world].ravel()) if getattr(kind, "_shape_", ()) else kind(value[world])
            setattr(instance, name, value)
        return instance
