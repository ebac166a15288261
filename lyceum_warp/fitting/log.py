"""Read a robot's logs, check them against a model, and cut them into takes without gaps."""

import dataclasses
import itertools
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import mujoco
import numpy as np

from lyceum_warp.controllers import Trajectory
from lyceum_warp.core import element_names, elements
from lyceum_warp.support.suggestions import did_you_mean

LogSource: TypeAlias = str | Path | Trajectory | Mapping[str, Any] | Iterable[Any]
"""A file (.npz, .csv, or a saved episode), an episode, a mapping of arrays by name, or several of these: takes."""
Controls: TypeAlias = Callable[[np.ndarray], np.ndarray]
"""Converts actions (samples, nact) to controls (samples, nu)."""

MEASURED = ("qpos", "qvel", "act", "sensordata", "actuator_force")
"""Fields that a log may have measured."""
_NAME = re.compile(r"(?P<field>[a-z_]+)(?:\.(?P<element>.+?))?(?:\[(?P<index>\d+)\])?")
_LONGEST_STEP, _GAP, _FEWEST = 1.0, 5.5, 20
_SWAPPED = 0.25
"""Two joints are swapped if their correlations exceed the right ones by this."""


@dataclasses.dataclass(frozen=True)
class Column:
    """One measured number."""

    name: str
    """Name in the log, such as "qpos.knee" or "sensordata.gyro[2]"."""
    field: str
    index: int
    """Index of the number in the flat field."""


@dataclasses.dataclass(frozen=True)
class Take:
    """A part of a log without gaps."""

    time: np.ndarray
    """Seconds, (samples,), increasing."""
    control: np.ndarray
    """Controls from each time to the next, (samples, nu)."""
    measured: np.ndarray
    """Measurements, (samples, columns); NaN for a missing sample."""


@dataclasses.dataclass(frozen=True)
class Log:
    """A log that fits a model: its measured columns, and its takes."""

    columns: tuple[Column, ...]
    takes: tuple[Take, ...]
    notes: tuple[str, ...] = ()
    """What a reader should know about the log, such as its gaps."""


def read_log(source: LogSource, model: mujoco.MjModel, controls: Controls | None = None) -> Log:
    """Read a log and check it.

    Args:
        source: Files, episodes, or mappings of arrays; ``docs/fitting.md`` lists the names of columns.
        model: The model whose names the log uses.
        controls: Converts actions to controls.

    Raises:
        FileNotFoundError: A file does not exist.
        ValueError: The log is damaged or does not fit the model. The message names the column and the fix.
    """
    notes: list[str] = []
    takes: list[Take] = []
    columns: tuple[Column, ...] = ()
    for name, table in _tables(source):
        quantities, take = _take(name, table, model, controls)
        columns = columns or quantities
        if odd := {column.name for column in {*columns} ^ {*quantities}}:
            raise ValueError(f"{name} measures other quantities than the first take: {', '.join(sorted(odd))}")
        order = [quantities.index(column) for column in columns]
        takes += _cut(name, dataclasses.replace(take, measured=take.measured[:, order]), notes)
    if not takes:
        raise ValueError("there is no log: pass a file, an episode or a mapping of arrays")
    log = Log(columns, tuple(takes), tuple(notes))
    _check_joints(log, model)
    return log


def _tables(source: LogSource) -> Iterable[tuple[str, Mapping[str, Any]]]:
    """Yield the name and the arrays of each take."""
    if isinstance(source, Trajectory):
        # a step's control is part of the state after the step
        names = [name for name in ("qpos", "qvel", "act") if name in source.state_parts]
        ctrl = source.part("ctrl").numpy()
        table = {"time": source.timestep * np.arange(source.steps + 1), "ctrl": np.concatenate([ctrl[1:], ctrl[-1:]])}
        yield "the episode", table | {name: source.part(name).numpy() for name in names}
    elif isinstance(source, Mapping):
        yield "the log", source
    elif not isinstance(source, str | Path):
        for number, part in enumerate(source):
            yield from ((f"take {number}" if name == "the log" else name, table) for name, table in _tables(part))
    elif not Path(source).is_file():
        raise FileNotFoundError(f"there is no log {str(source)!r}")
    else:
        try:
            table = _read(Path(source))
        except Exception as error:  # numpy and zipfile raise many types of errors
            text = " ".join(str(error).split())[:200]
            raise ValueError(f"{source} is no log: it must be .npz or .csv ({text})") from error
        yield from [(str(source), table)] if table else _tables(Trajectory.load(source))


def _read(path: Path) -> dict[str, np.ndarray]:
    """Read a file's arrays. A saved episode has none."""
    if path.suffix == ".csv":
        rows = np.genfromtxt(path, delimiter=",", names=True, deletechars="", encoding="utf-8")
        return {name: np.atleast_1d(rows[name]) for name in rows.dtype.names or ()}
    with np.load(path, allow_pickle=False) as file:
        return {} if "states" in file else {name: file[name] for name in file.files}


def _take(
    name: str, table: Mapping[str, Any], model: mujoco.MjModel, controls: Controls | None
) -> tuple[tuple[Column, ...], Take]:
    try:
        arrays = {str(key): np.asarray(value, dtype=np.float64) for key, value in table.items()}
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} has values that are no numbers ({error})") from error
    if "time" not in arrays:
        raise ValueError(f"{name} has no column 'time' (seconds): it has {', '.join(arrays) or 'no columns'}")
    time = arrays.pop("time").reshape(-1)
    if not np.isfinite(time).all() or len(time) < _FEWEST or (np.diff(time) <= 0).any():
        raise ValueError(
            f"{name}: its {len(time)} times must be at least {_FEWEST} finite numbers that increase: sort the rows, "
            "and pass several recordings as a list"
        )
    if (step := float(np.median(np.diff(time)))) > _LONGEST_STEP:
        raise ValueError(f"{name}: two samples are {step:g} s apart: convert 'time' to seconds")
    control, columns = np.full((len(time), model.nu), np.nan), {}
    for key, array in arrays.items():
        if array.ndim not in (1, 2) or len(array) != len(time):
            raise ValueError(f"{name}: {key!r} has shape {array.shape} for {len(time)} times: pass one row per time")
        array = array.reshape(len(time), -1)
        if key.partition(".")[0] in ("action", "ctrl") and not np.isfinite(array).all():
            row = int(np.argwhere(~np.isfinite(array))[0, 0])
            raise ValueError(f"{name}: {key!r} is not finite in row {row}: repeat the last control, or cut there")
        if key == "action" and controls is not None:
            control = controls(array)
            continue
        field, places = _places(f"{name}: the column {key!r}", key, model)
        if len(places) != array.shape[1]:
            raise ValueError(
                f"{name}: {key!r} has {array.shape[1]} numbers per time, and the model's has {len(places)}: is it the "
                "log of another robot?"
            )
        if field == "ctrl":
            control[:, places] = array
            continue
        for place, values in zip(places, array.T, strict=True):
            label = key if len(places) == 1 else f"{key}[{place - places[0]}]"
            columns[Column(label, field, place)] = values
            if np.isinf(values).any() or np.isnan(values).all():
                raise ValueError(f"{name}: the column {label!r} has no numbers, or infinite ones: leave it out")
            if np.nanmax(values) == np.nanmin(values):
                raise ValueError(
                    f"{name}: the column {label!r} is always {np.nanmax(values):g}: is the sensor connected?"
                )
    if np.isnan(control).any():
        missing = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, int(np.isnan(control[0]).argmax()))
        raise ValueError(f"{name} lacks controls of the actuator {missing!r}: add the column 'ctrl.{missing}'")
    if not columns:
        raise ValueError(f"{name} measures nothing: add columns such as 'qpos.JOINT'; fields are {', '.join(MEASURED)}")
    return tuple(columns), Take(time, control, np.stack(list(columns.values()), axis=1))


def _places(text: str, key: str, model: mujoco.MjModel) -> tuple[str, list[int]]:
    """Find the indices in a flat field to which a column's name refers."""
    match, fields = _NAME.fullmatch(key), ("ctrl", *MEASURED)
    field = match["field"] if match else key
    if match is None or field not in fields:
        hint = did_you_mean(field, fields, f"use time, {', '.join(fields)}")
        hint = "a model without a task takes 'ctrl', not 'action'" if field == "action" else hint
        raise ValueError(f"{text} is unknown: {hint}")
    places = list(range(len(getattr(mujoco.MjData(model), field))))
    if element := match["element"]:
        names = element_names(model, field)
        if element not in names:
            hint = did_you_mean(element, names, f"it has {', '.join(names) or 'none with names'}")
            raise ValueError(f"{text} names nothing of the model's {field!r}: {hint}")
        places = places[elements(model, field, element)]
    if match["index"] is not None:
        if int(match["index"]) >= len(places):
            raise ValueError(f"{text} is out of range: there are {len(places)} numbers")
        places = [places[int(match["index"])]]
    return field, places


def _cut(name: str, take: Take, notes: list[str]) -> list[Take]:
    """Cut a take at its gaps."""
    steps = np.diff(take.time)
    gaps = np.flatnonzero(steps > _GAP * np.median(steps)) + 1
    if len(gaps):
        notes.append(f"{name} has {len(gaps)} gaps, the longest of {steps.max():.3g} s, and is cut there")
    spans = [slice(a, b) for a, b in itertools.pairwise([0, *gaps, len(take.time)]) if b - a >= _FEWEST]
    if not spans:
        raise ValueError(f"{name} has {len(gaps)} gaps, and no part of {_FEWEST} samples without one: record it again")
    return [Take(take.time[span], take.control[span], take.measured[span]) for span in spans]


def _check_joints(log: Log, model: mujoco.MjModel) -> None:
    """Refuse joints in other units, and joints that follow each other's servos or move by each other's velocities."""
    places = {(column.field, column.index): i for i, column in enumerate(log.columns)}
    values = np.concatenate([take.measured for take in log.takes])
    pairs = []
    for j in np.flatnonzero(model.jnt_type >= mujoco.mjtJoint.mjJNT_SLIDE.value):
        if (position := places.get(("qpos", int(model.jnt_qposadr[j])))) is None:
            continue
        low, high = model.jnt_range[j]
        least, most = np.nanmin(values[:, position]), np.nanmax(values[:, position])
        if model.jnt_limited[j] and (least < 2.0 * low - high or most > 2.0 * high - low):
            raise ValueError(
                f"{log.columns[position].name!r} reaches from {least:.3g} to {most:.3g}, but the joint's range is "
                f"{low:.3g} to {high:.3g}: convert degrees to radians, or subtract the encoder's offset"
            )
        if (velocity := places.get(("qvel", int(model.jnt_dofadr[j])))) is not None:
            pairs.append((position, velocity))
    driven = np.flatnonzero((model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_biasprm[:, 1] < 0))
    followed = {int(model.actuator_ctrladr[i]): ("qpos", int(model.jnt_qposadr[model.actuator_trnid[i, 0]]))
                for i in driven}  # fmt: skip
    servos = [(control, places[key]) for control, key in followed.items() if key in places]
    for take in log.takes:
        rates = np.gradient(take.measured, take.time, axis=0)
        for position, velocity in pairs:
            rate = rates[:, position]
            if np.nansum(rate * take.measured[:, velocity]) > 5.0 * np.nansum(rate * rate):
                raise ValueError(
                    f"{log.columns[velocity].name!r} is more than 5 times the change of {log.columns[position].name!r} "
                    "per second: convert both to the same units (radians, metres, seconds)"
                )
        _check_match("follows the control of", log, take.control, take.measured, servos)
        _check_match("moves by the velocity of", log, rates, take.measured, pairs)


def _check_match(verb: str, log: Log, causes: np.ndarray, measured: np.ndarray, pairs: list[tuple[int, int]]) -> None:
    """Check that each pair's column correlates most with its own cause, with any lag up to 0.2 s."""
    lags = np.linspace(0.0, 0.2 / np.median(np.diff(log.takes[0].time)), 9).astype(int)
    cause, column = np.array(pairs, dtype=int).reshape(-1, 2).T
    rows = np.flatnonzero(np.isfinite(measured[:, column]).all(axis=1) & np.isfinite(causes[:, cause]).all(axis=1))
    rows = rows[rows < len(measured) - lags[-1]]
    if len(pairs) < 2 or len(rows) < _FEWEST:
        return
    with np.errstate(invalid="ignore", divide="ignore"):
        later = (np.nan_to_num(measured[rows + lag][:, column]) for lag in lags)
        matches = [np.corrcoef(causes[rows][:, cause].T, seen.T)[: len(pairs), len(pairs) :] for seen in later]
        match = np.nan_to_num(matches).max(axis=0)
    for i, other in enumerate(match.argmax(axis=0)):
        # a pair that correlates both ways is swapped; one way alone is a robot that moves as a whole
        if match[other, i] > match[i, i] + _SWAPPED and match[i, other] > match[other, other] + _SWAPPED:
            names = log.columns[column[i]].name, log.columns[column[other]].name
            raise ValueError(
                f"{names[0]!r} {verb} {names[1]!r} (correlation {match[other, i]:.2f}, its own {match[i, i]:.2f}): are "
                "these joints swapped?"
            )
