"""Check the values of a task's parameters (the fields of ``Params``), and pass them to kernels in an array."""

import copy
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.core.fields import elements, rows
from lyceum_warp.core.options import OPTIONS, suggestion
from lyceum_warp.core.task import Element, FromModel

_FILLED_IN = ("dt", "substep_dt")
"""Parameters that the package sets: the durations of a step and of a substep, in seconds."""

_SCALARS: dict[Any, Any] = {wp.bool: bool, wp.int32: int}
"""The Python types of scalars that are no floats."""


def defaults(struct: Any, owner: type) -> dict[str, Any]:
    """Return the defaults of a task's parameters, without ``dt`` and ``substep_dt``.

    ``struct`` declares the parameters, and the class ``owner`` has the defaults as attributes.
    """
    names = [name for name in struct.vars if name not in _FILLED_IN and hasattr(owner, name)]
    return {name: getattr(owner, name) for name in names}


class Parameters:
    """The values of a task's parameters: scalars, vectors, arrays with one value per world, or tables.

    A table is a field that is itself an array, such as ``motion: wp.array2d[float]``. All worlds share it.

    The weights of the task's terms are set like parameters.
    """

    def __init__(
        self, source: TaskSource, model: mujoco.MjModel, values: Mapping[str, Any], *, nworld: int, timestep: float
    ) -> None:
        self._struct, self._owner, self._weights = source.params, source.defaults, source.terms.weights
        self._model, self._nworld = model, nworld
        self._names = (*self._struct.vars, *self._weights)
        self._sizes: dict[str, int] = {}
        self.tables = {name: field.type for name, field in self._struct.vars.items() if hasattr(field.type, "ndim")}
        self._arrays: dict[str, tuple[Any, Any]] = {}
        self._check_tables()
        if taken := [name for name in self._names if name in (*OPTIONS, "task", "options")]:
            raise ValueError(
                f"the parameter {taken[0]!r} has the name of an option of make(), so make() would set the option: "
                "rename it in Params"
            )
        times = {"dt": timestep, "substep_dt": float(model.opt.timestep)}
        initial = defaults(self._struct, self._owner) | self._weights | times
        self._computed = {name for name, value in initial.items() if isinstance(value, FromModel)}
        self.values: dict[str, Any] = {name: initial[name] for name in self._names if name in initial}
        self.values = self.changed(values).values
        self._computed -= set(values)

    @property
    def per_world(self) -> dict[str, np.ndarray]:
        """The values of the parameters that differ between worlds, (nworld, ...)."""
        return {name: v for name, v in self.values.items() if isinstance(v, np.ndarray) and name not in self.tables}

    def changed(self, values: Mapping[str, Any]) -> "Parameters":
        """Return a copy with some values replaced. The copy and the original share arrays."""
        names = sorted(set(self._names) - set(_FILLED_IN))
        for name in values:
            if name in OPTIONS:
                raise ValueError(
                    f"{name!r} is an option, not a parameter: make another environment with env.replicate({name}=...)"
                )
            if name not in names:
                hint = suggestion(name, names) or f"it has {', '.join(names) or 'none'}"
                raise ValueError(f"there is no parameter {name!r}: {hint}")
        if missing := [name for name in self._names if name not in self.values and name not in values]:
            raise ValueError(f"it needs values for {', '.join(missing)}")
        other = copy.copy(self)
        other._computed = self._computed - set(values)
        other.values = {
            name: self._converted(name, value)
            for name, value in {**self.values, **values}.items()
            if name not in other._computed
        }
        for name in self._names:
            if name in other._computed:
                other.values[name] = self._compute(name, other.values)
        return other

    def _compute(self, name: str, values: Mapping[str, Any]) -> Any:
        """Compute a default from the model. Return the previous table if its contents did not change."""
        try:
            result = getattr(self._owner, name).function(self._model, SimpleNamespace(**values))
        except Exception as error:  # the task's function may raise any error
            message = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
            raise ValueError(f"the parameter {name} can't be computed: {message}") from error
        value, before = self._converted(name, result), self.values[name]
        return before if name in self.tables and np.array_equal(before, value) else value

    def array(self, device: wp.Device) -> wp.array:
        """Make the kernels' array of ``Params``: one entry for all worlds, or one per world.

        The entries contain pointers to tables on the device, which this object keeps alive. New values of the same
        shape are copied into the existing table.
        """
        for name, kind in self.tables.items():
            value = self.values[name]
            previous, array = self._arrays.get(name, (None, None))
            if array is None or previous.shape != value.shape:
                array = wp.array(value, dtype=kind.dtype, device=device)
            elif previous is not value:
                array.assign(value)
            self._arrays[name] = value, array
        differ = any(name in self._struct.vars for name in self.per_world)
        instances = [self._instance(w) for w in range(self._nworld if differ else 1)]
        return wp.array(instances, dtype=self._struct, device=device)

    def weights(self, device: wp.Device) -> wp.array:
        """Make the array of the terms' weights, (1 or nworld, terms)."""
        count = self._nworld if any(name in self._weights for name in self.per_world) else 1
        rows = [np.broadcast_to(self.values[name], count) for name in self._weights]
        table: wp.array = wp.array(np.reshape(rows, (len(rows), count)).T, dtype=float, device=device)
        return table

    def _check_tables(self) -> None:
        for name, kind in self.tables.items():
            scalar = getattr(kind.dtype, "_wp_scalar_type_", kind.dtype)
            if not wp.types.type_repr(kind).startswith("array(") or scalar not in (wp.float32, wp.int32):
                raise ValueError(
                    f"the parameter {name!r} has the type {wp.types.type_repr(kind)}: a table is a wp.array, "
                    "wp.array2d or wp.array3d of float, int, or vectors and matrices of float"
                )

    def _converted(self, name: str, value: Any) -> Any:
        """Convert a value to its field's type: a scalar, a vector, a table, or an array with one value per world."""
        if name in self.tables:
            return self._table(name, value)
        kind = self._struct.vars[name].type if name in self._struct.vars else wp.float32
        text = f"the parameter {name}={value!r}"
        array = self._numbers(name, text, value, whole=kind is wp.int32)
        if np.isnan(array).any():
            raise ValueError(f"{text} is not a number")
        shape = tuple(getattr(kind, "_shape_", ()))
        per_world = (self._nworld, *shape)
        if array.shape not in (shape, per_world):
            takes = f"{shape or 'one number'}, or one per world, {per_world}"
            raise ValueError(f"{text} has shape {array.shape}: it takes {takes}")
        if kind in (wp.bool, wp.int32) and not (array == np.round(array)).all():
            raise ValueError(f"{text} must be a whole number")
        if array.shape != shape:
            return array
        return kind(*array.ravel()) if shape else _SCALARS.get(kind, float)(array.item())

    def _table(self, name: str, value: Any) -> np.ndarray:
        """Convert a table to a read-only array of float32 or int32. The last axes are those of a vector or matrix."""
        if value is self.values.get(name) and isinstance(value, np.ndarray) and not value.flags.writeable:
            return value
        kind, text = self.tables[name], f"the parameter {name}"
        element = tuple(getattr(kind.dtype, "_shape_", ()))
        whole = getattr(kind.dtype, "_wp_scalar_type_", kind.dtype) is wp.int32
        if isinstance(value, (str, Path)):
            text += f" from {str(value)!r}"
            value = _loaded(text, value)
        array = self._numbers(name, text, value, whole=whole)
        with np.errstate(over="ignore", invalid="ignore"):
            table: np.ndarray = array.astype(np.int32 if whole else np.float32)
        axes = kind.ndim + len(element)
        if table.ndim != axes or table.shape[kind.ndim :] != element or not table.size:
            last = f", the last {element}" if element else ""
            raise ValueError(f"{text} has shape {table.shape}: it takes {axes} axes{last}, with no axis of length 0")
        bad = table != array if whole else ~np.isfinite(table)
        if bad.any():
            place = np.argwhere(bad)[0].tolist()
            number = "a whole number of 32 bits" if whole else "a finite number of 32 bits"
            raise ValueError(f"{text} has {array[tuple(place)]} at {place}: it must be {number}")
        table.flags.writeable = False
        return table

    def _numbers(self, name: str, text: str, value: Any, *, whole: bool) -> np.ndarray:
        """Convert a value to an array of float64, and elements of the model to their indices."""
        field = _element_field(getattr(self._owner, name, None))
        value = self._indices(text, value, field, whole=whole)
        try:
            value = value.detach().cpu() if hasattr(value, "detach") else value
            array = np.asarray(value.numpy() if isinstance(value, wp.array) else value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{text} must be numbers: {error}") from error
        if field:
            if field not in self._sizes:
                self._sizes[field] = rows(self._model, field)
            if ((array < 0) | (array >= self._sizes[field])).any():
                last = self._sizes[field] - 1
                raise ValueError(f"{text} is not an index of {field!r}: give an index from 0 to {last}, or a name")
        return array

    def _indices(self, text: str, value: Any, field: str | None, *, whole: bool) -> Any:
        """Replace model elements by their indices. With ``field``, also replace the elements' names."""
        if isinstance(value, list | tuple):
            return [self._indices(text, entry, field, whole=whole) for entry in value]
        if isinstance(value, Element):
            if not whole or field not in (None, value.field):
                raise ValueError(f"{text} can't be an element of {value.field!r}: it takes {field or 'numbers'}")
            return elements(self._model, value.field, value.name).start
        return elements(self._model, field, value).start if field and isinstance(value, str) else value

    def _instance(self, world: int) -> Any:
        instance = self._struct()
        for name, variable in self._struct.vars.items():
            kind, value = variable.type, self.values[name]
            if name in self.tables:
                _, value = self._arrays[name]
            elif isinstance(value, np.ndarray):
                scalar = _SCALARS.get(kind, float)
                value = kind(*value[world].ravel()) if getattr(kind, "_shape_", ()) else scalar(value[world])
            setattr(instance, name, value)
        return instance


def _element_field(default: Any) -> str | None:
    """If a default names elements of the model, return their field, such as "site_xpos" for sites."""
    while isinstance(default, list | tuple) and default:
        default = default[0]
    return default.field if isinstance(default, Element) else None


def _loaded(text: str, path: str | Path) -> np.ndarray:
    try:
        # map the file instead of reading it: a broken header could make NumPy allocate any amount of memory
        return np.array(np.lib.format.open_memmap(path, mode="r"))
    except FileNotFoundError:
        raise FileNotFoundError(f"{text} cannot be read, because there is no such file") from None
    except Exception as error:  # NumPy raises many types of errors
        raise ValueError(f"{text} is not a file of np.save with numbers: {error}") from error
