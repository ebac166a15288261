"""Describe what a fit may change: model fields, delays, and the gains and biases of sensors."""

import copy
import dataclasses
import fnmatch
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import mujoco
import numpy as np

from lyceum_warp.core import NOT_NEGATIVE, VARYING_FIELDS, element_names, elements
from lyceum_warp.support.docstrings import document_attributes
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.support.validate import finite_number

_NAME = re.compile(r"(?P<field>[a-z0-9_]+)\.(?P<pattern>.+?)(?:\[(?P<column>\d+)\])?")
_INERTIAL = ("body_mass", "body_ipos", "body_iquat", "body_inertia")
_Part: TypeAlias = tuple[str, int | None, float]
_TOGETHER: dict[str, list[_Part]] = {
    "kp": [("actuator_gainprm", 0, 1.0), ("actuator_biasprm", 1, -1.0)], "kd": [("actuator_biasprm", 2, -1.0)],
    "body_mass": [("body_mass", None, 1.0), ("body_inertia", None, 1.0)],
    "inertia": [(name, None, 1.0) for name in _INERTIAL],
}  # fmt: skip
"""Model fields, columns and signs of what changes together."""
_SIGNALS = {"delay": (0.02, 0.0, 0.05), "gain": (0.1, -np.log(10.0), np.log(10.0)), "bias": (0.02, -np.inf, np.inf)}
"""The prior's deviation and the bounds of parameters of signals. A gain is a factor."""
_SIGNED = {"body_ipos": 0.02, "body_pos": 0.01, "geom_pos": 0.01, "site_pos": 0.01, "jnt_pos": 0.01, "qpos_spring": 0.1}
"""Fields whose columns are shifted apart, with the prior's deviation of the shift."""
_FROM_ZERO = {"dof_armature": 0.02, "dof_damping": 0.5, "dof_frictionloss": 0.5, "jnt_stiffness": 1.0}
"""The prior's deviation of fields whose nominal value is 0."""
_FACTOR, _RANGE, _INERTIA = 0.5, np.log(10.0), 0.2
_FACTORS = ("factor", "gain")
"""Kinds of coordinates that are logarithms."""


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameter:
    """Something that ``lw.fit`` changes to explain a log.

    ``name`` is FIELD.ELEMENTS or FIELD.ELEMENTS[COLUMN], as "dof_damping.*_knee" or "geom_friction.foot[0]". ELEMENTS
    are names of elements, separated by commas, and may have the wildcards of a shell.

    =======================  ==========================================================================================
    a model field            one factor for all elements; a field that is 0 grows from 0; positions shift, in m
    ``body_mass``            one factor for masses and inertias
    ``kp``, ``kd``           one factor for the gains of position servos
    ``inertia``              mass, centre of mass and inertia of each body, ten numbers that stay physical
    ``delay``                seconds from a control to its effect (``delay.ctrl.*``) or from a motion to its measurement
                             (``delay.qvel.*``)
    ``gain``, ``bias``       a logged number is gain * value + bias, for controls and measurements
    =======================  ==========================================================================================

    Factors and gains have a normal prior of the logarithm around 0, and all others one around the nominal value.
    """

    name: str
    each: bool = False
    """Whether each element gets a parameter of its own."""
    prior: float | None = None
    """Standard deviation of the prior: of a factor's logarithm, or in the field's units. The default depends on the
    field; for factors, it is 0.5."""
    low: float | None = None
    """Least factor or value."""
    high: float | None = None
    """Greatest factor or value."""

    def __post_init__(self) -> None:
        if _NAME.fullmatch(str(self.name)) is None:
            raise ValueError(f"the parameter {self.name!r} must be FIELD.ELEMENTS, as in 'dof_damping.*'")
        for name in ("prior", "low", "high"):
            if getattr(self, name) is not None:
                finite_number(f"{name} of {self.name}", getattr(self, name), low=1e-12 if name == "prior" else -np.inf)


@dataclasses.dataclass(frozen=True)
class Coordinate:
    """One number that the fit changes. It is 0 at the nominal value."""

    name: str
    kind: str
    """"factor", "shift", "inertia", or a key of ``_SIGNALS``."""
    std: float
    low: float
    high: float
    writes: Sequence[tuple[str, np.ndarray, float]] = ()
    """Fields, the flat indices in them, and the signs of shifts."""
    signals: Sequence[int] = ()
    """Indices of controls, and of columns of the log after them."""

    def value(self, x: Any) -> Any:
        """Convert coordinates to factors or values."""
        return np.exp(x) if self.kind in _FACTORS else x


class Parameters:
    """The coordinates of a fit, bound to a model and to the columns of a log."""

    def __init__(
        self, parameters: Iterable[Parameter | str], model: mujoco.MjModel, columns: Sequence[str] = ()
    ) -> None:
        self.nominal, self._data = model, mujoco.MjData(model)
        self._count = model.nu + len(columns)
        controls = {f"ctrl.{name}": elements(model, "ctrl", name) for name in element_names(model, "ctrl")}
        self.actuators = {name.removeprefix("ctrl."): part.start for name, part in controls.items()}
        """Index of the first control of each actuator."""
        self._signals = {name: range(part.start, part.stop) for name, part in controls.items()} | {
            name: range(model.nu + i, model.nu + i + 1) for i, name in enumerate(columns)
        }
        self.coordinates: list[Coordinate] = []
        self.touched: dict[str, set[str]] = {}
        """The names of the elements that the fit changes, by field."""
        for parameter in parameters:
            self._add(Parameter(name=parameter) if isinstance(parameter, str) else parameter)
        if not self.coordinates:
            raise ValueError("there is nothing to fit: pass parameters, as in ['dof_damping.*', 'delay.ctrl.*']")
        names = [coordinate.name for coordinate in self.coordinates]
        if len(set(names)) < len(names):
            raise ValueError(f"the parameter {max(names, key=names.count)!r} is given twice")
        self.names, self.size = names, len(names)
        self.std, self.low, self.high = (
            np.array([getattr(c, name) for c in self.coordinates]) for name in ("std", "low", "high")
        )

    def _add(self, parameter: Parameter) -> None:
        match = _NAME.fullmatch(parameter.name)
        assert match is not None
        field, fields = match["field"], dict.fromkeys((*VARYING_FIELDS, *_TOGETHER, *_SIGNALS))
        if field not in fields:
            raise ValueError(f"the parameter {parameter.name!r} can't be fitted: {did_you_mean(field, fields)}")
        column = None if match["column"] is None else int(match["column"])
        parts = _TOGETHER.get(field, [(field, column, 1.0)])
        names = list(self._signals) if field in _SIGNALS else element_names(self.nominal, parts[0][0])
        wanted = match["pattern"].split(",")
        for pattern in wanted:
            if not fnmatch.filter(names, pattern):
                hint = did_you_mean(pattern, names, f"it has {', '.join(names) or 'none with names'}")
                raise ValueError(f"the parameter {parameter.name!r} fits no element of the model or the log: {hint}")
        # a wildcard for joints does not mean the free joint of a base
        base = [self.nominal.joint(j).name for j in np.flatnonzero(self.nominal.jnt_type == mujoco.mjtJoint.mjJNT_FREE)]
        hidden = set(base) - set(wanted) if field.startswith("dof_") else set()
        names = [name for name in names if name not in hidden and any(fnmatch.fnmatchcase(name, p) for p in wanted)]
        width = 0 if field in _SIGNALS else getattr(self.nominal, parts[0][0])[0].size
        if column is not None and column >= width:
            raise ValueError(f"the parameter {parameter.name!r} is out of range: {field} has {width} columns")
        apart = parameter.each or field == "inertia"
        for label, members in [(name, [name]) for name in names] if apart else [(match["pattern"], names)]:
            full = f"{field}.{label}" + ("" if column is None else f"[{column}]")
            if field in _SIGNALS:
                signals = [i for name in members for i in self._signals[name]]
                self._append(parameter, full, field, *_SIGNALS[field], signals=signals)
            elif field in _SIGNED and column is None:
                for k in range(width):
                    self._add_field(parameter, f"{full}[{k}]", field, members, [(field, k, 1.0)])
            else:
                self._add_field(parameter, full, field, members, parts)

    def _add_field(self, parameter: Parameter, name: str, field: str, members: list[str], parts: list[_Part]) -> None:
        writes = []
        for part, column, sign in parts:
            self.touched.setdefault(part, set()).update(members)
            values = np.asarray(getattr(self.nominal, part))
            grid = np.arange(values.size).reshape(len(values), -1)
            rows = np.concatenate([grid[elements(self.nominal, part, member)] for member in members])
            writes.append((part, rows.ravel() if column is None else rows[:, column], sign))
        if field == "inertia":
            nominal = {part: getattr(self.nominal, part) for part in _INERTIAL}
            if np.linalg.eigvalsh(_pseudo_inertia(nominal, writes[0][1][0]))[0] <= 0.0:
                raise ValueError(f"the body {members[0]!r} has no physical inertia: fit its body_mass, or correct it")
            for k in range(10):
                self._append(parameter, f"{name}[{k}]", field, _INERTIA, -np.inf, np.inf, writes=writes)
        elif field in _SIGNED:
            self._append(parameter, name, "shift", _SIGNED[field], -np.inf, np.inf, writes=writes)
        elif any(getattr(self.nominal, part).reshape(-1)[places].any() for part, places, _ in writes):
            self._append(parameter, name, "factor", _FACTOR, -_RANGE, _RANGE, writes=writes)
        else:
            least = 0.0 if field in (*NOT_NEGATIVE, "kp", "kd") else -np.inf
            self._append(parameter, name, "shift", _FROM_ZERO.get(field, 1.0), least, np.inf, writes=writes)

    def _append(
        self, parameter: Parameter, name: str, kind: str, std: float, low: float, high: float, **more: Any
    ) -> None:
        if kind in _FACTORS and min(parameter.low or 1.0, parameter.high or 1.0) <= 0.0:
            raise ValueError(f"the bounds of {parameter.name!r} are factors of the nominal value, and must be positive")
        into: Callable[[float], float] = np.log if kind in _FACTORS else float
        low, high = (
            old if new is None else float(into(new)) for old, new in ((low, parameter.low), (high, parameter.high))
        )
        if not low <= 0.0 <= high or low == high:
            raise ValueError(f"the bounds of {parameter.name!r} must lie around the nominal value")
        self.coordinates.append(Coordinate(name, kind, parameter.prior or std, low, high, **more))

    def values(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Compute the model fields of a hypothesis."""
        values = {field: getattr(self.nominal, field).copy() for field in self.touched}
        inertias: dict[int, list[float]] = {}
        for x_i, coordinate in zip(x, self.coordinates, strict=True):
            if coordinate.kind == "inertia":
                inertias.setdefault(int(coordinate.writes[0][1][0]), []).append(x_i)
                continue
            for field, places, sign in coordinate.writes:
                flat = values[field].reshape(-1)
                flat[places] = flat[places] * np.exp(x_i) if coordinate.kind == "factor" else flat[places] + sign * x_i
        for body, numbers in inertias.items():
            if any(numbers):
                _change_inertia(values, body, numbers)
        return values

    def model(self, x: np.ndarray) -> mujoco.MjModel:
        """Make the model of a hypothesis."""
        model = copy.copy(self.nominal)
        for field, rows in self.values(x).items():
            getattr(model, field)[...] = rows
        mujoco.mj_setConst(model, self._data)
        return model

    def signals(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Get delay, gain and bias of each control and then of each column of the log."""
        values = {kind: np.zeros(self._count) for kind in _SIGNALS}
        for value, coordinate in zip(x, self.coordinates, strict=True):
            if coordinate.kind in values:
                values[coordinate.kind][coordinate.signals] += value
        return values | {"gain": np.exp(values["gain"])}

    def fields(self, x: np.ndarray) -> dict[str, dict[str, list[Any]]]:
        """Get the rows that the fit changes, by field and element."""
        values = self.values(x)
        return {
            field: {name: values[field][elements(self.nominal, field, name)].tolist() for name in sorted(names)}
            for field, names in self.touched.items()
        }


def _pseudo_inertia(values: Mapping[str, np.ndarray], body: int) -> np.ndarray:
    """Compute the pseudo-inertia (Wensing et al., 2018), (4, 4): second and first moments of mass, and the mass."""
    flat = np.zeros(9)
    mujoco.mju_quat2Mat(flat, values["body_iquat"][body])
    turn = flat.reshape(3, 3)
    inertia, mass, centre = (values[name][body] for name in ("body_inertia", "body_mass", "body_ipos"))
    moments = turn @ np.diag(0.5 * inertia.sum() - inertia) @ turn.T + mass * np.outer(centre, centre)
    return np.block([[moments, mass * centre[:, None]], [mass * centre[None], np.full((1, 1), mass)]])


def _change_inertia(values: Mapping[str, np.ndarray], body: int, numbers: Sequence[float]) -> None:
    """Multiply the Cholesky factor of a body's pseudo-inertia, so that the inertia stays physical."""
    turn = np.diag(np.exp(numbers[:4]))
    turn[np.tril_indices(4, -1)] = numbers[4:]
    root = np.linalg.cholesky(_pseudo_inertia(values, body)) @ turn
    pseudo = root @ root.T
    mass = pseudo[3, 3]
    centre = pseudo[:3, 3] / mass
    moments, axes = np.linalg.eigh(pseudo[:3, :3] - mass * np.outer(centre, centre))
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    values["body_mass"][body], values["body_ipos"][body] = mass, centre
    values["body_inertia"][body] = moments.sum() - moments
    mujoco.mju_mat2Quat(values["body_iquat"][body], np.ascontiguousarray(axes).ravel())
