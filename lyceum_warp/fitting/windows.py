"""Cut a log into windows, guess their initial states, and predict what each window measured."""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeAlias

import mujoco
import numpy as np
from mujoco.batch import Batch

from lyceum_warp.engines import call_batch
from lyceum_warp.fitting.log import Column, Log
from lyceum_warp.fitting.parameters import Parameters
from lyceum_warp.support.machine import cpu_cores

Signals: TypeAlias = dict[str, np.ndarray]
"""Delay, gain and bias of each control, and then of each column of the log."""
WORLDS = 1024
"""Worlds of a batch. More would only take more memory."""
_QUATERNION = {mujoco.mjtJoint.mjJNT_FREE: 3, mujoco.mjtJoint.mjJNT_BALL: 0}
"""Numbers of position before the quaternion, by the type of joint."""


@dataclasses.dataclass(frozen=True)
class Windows:
    """Short parts of a log. Each is predicted from its own initial state, so that chaos can't build up."""

    take: np.ndarray
    """Indices of the takes, (windows,)."""
    begin: np.ndarray
    """Time at which each window begins, (windows,)."""
    steps: int
    """Substeps of a window."""
    seconds: float
    """Their duration."""
    time: np.ndarray
    """Times of the samples since the window's beginning in substeps, (windows, samples)."""
    measured: np.ndarray
    """(windows, samples, columns); NaN for a missing number."""

    def __len__(self) -> int:
        return len(self.take)

    @property
    def follows(self) -> np.ndarray:
        """Whether each window begins where the one before it ends, (windows,)."""
        late = self.begin - np.roll(self.begin, 1) - self.seconds
        return (self.take == np.roll(self.take, 1)) & (np.abs(late) < 1e-6)

    def chosen(self, which: Any) -> "Windows":
        """Select windows."""
        arrays = ("take", "begin", "time", "measured")
        return dataclasses.replace(self, **{name: getattr(self, name)[which] for name in arrays})


def cut_windows(log: Log, parameters: Parameters, seconds: float) -> Windows:
    """Cut a log into windows that begin at samples.

    Raises:
        ValueError: No take is as long as a window.
    """
    model = parameters.nominal
    step, steps = model.opt.timestep, max(2, round(seconds / model.opt.timestep))
    longest = np.where(np.isfinite(parameters.high), parameters.high, 0.0)
    lead = parameters.signals(longest)["delay"][model.nu :] / step
    rows: list[tuple[Any, ...]] = []
    for number, take in enumerate(log.takes):
        begin = take.time[0]
        while begin + steps * step <= take.time[-1] + 1e-6:
            # a record holds the state before each substep
            inside = np.flatnonzero((take.time > begin - 1e-6) & (take.time < begin + (steps - 1) * step + 1e-6))
            time = (take.time[inside] - begin) / step
            rows.append((number, begin, time, np.where(time[:, None] < lead - 1e-6, np.nan, take.measured[inside])))
            begin = take.time[np.searchsorted(take.time, begin + steps * step - 1e-6)]
    if not rows:
        raise ValueError(f"no take has the {seconds:g} s of a window: record longer takes, or shorten the window")
    most = max(len(row[2]) for row in rows)
    time, measured = np.zeros((len(rows), most)), np.full((len(rows), most, len(log.columns)), np.nan)
    for i, row in enumerate(rows):
        time[i, : len(row[2])], measured[i, : len(row[2])] = row[2:]
    takes, begins = (np.array([row[k] for row in rows]) for k in (0, 1))
    return Windows(takes, begins, steps, steps * step, time, measured)


class Predictor:
    """Predicts the measurements of windows under hypotheses, in worlds of the C engine in float64."""

    def __init__(self, log: Log, parameters: Parameters, *, nthread: int = 0) -> None:
        self.log, self.parameters, self.nthread = log, parameters, nthread or cpu_cores()
        self.model = parameters.nominal
        self.nx = 2 * self.model.nv + self.model.na
        """Numbers by which an initial state may differ from another: positions, velocities and activations."""
        fields, indices = (np.array([getattr(c, name) for c in log.columns]) for name in ("field", "index"))
        self.sources = {field: (np.flatnonzero(fields == field), indices[fields == field]) for field in set(fields)}
        """Places of each field's columns in the log, and their indices in the field."""
        self.quats = _quaternions(log.columns, self.model)
        self._data = mujoco.MjData(self.model)
        self._integrals = []
        for take in log.takes:
            # the first and the last control hold before and after the take
            time = np.concatenate([take.time[:1] - 10.0, take.time, take.time[-1:] + 10.0])
            pieces = np.diff(time)[:, None] * np.concatenate([take.control[:1], take.control])
            self._integrals.append((time, np.pad(np.cumsum(pieces, axis=0), ((1, 0), (0, 0)))))

    def track(self, windows: Windows, x: np.ndarray, memory: float) -> np.ndarray:
        """Guess the initial states of windows: simulate each take, and pull the state towards the measurements.

        The result has less noise than the measurements, obeys the contacts, and fills what was not measured.

        Args:
            windows: The windows.
            x: Coordinates of the parameters.
            memory: Seconds in which the simulation forgets its own state.

        Returns:
            qpos, qvel and act, (windows, nq + nv + na).
        """
        model, signals = self.parameters.model(x), self.parameters.signals(x)
        data, step = self._data, model.opt.timestep
        guess = np.empty((len(windows), model.nq + model.nv + model.na))
        gain, bias = (signals[name][model.nu :] for name in ("gain", "bias"))
        none = np.zeros((2, 0), int)
        columns = {name: self.sources.get(name, none) for name in ("qpos", "qvel")}
        # velocities that are not measured follow from positions
        change, derived = np.zeros(model.nv), ~np.isin(np.arange(model.nv), columns["qvel"][1])
        for number in np.unique(windows.take):
            take, members = self.log.takes[number], np.flatnonzero(windows.take == number)
            steps = round((windows.begin[members[-1]] - take.time[0]) / step) + 1
            whole = dataclasses.replace(windows.chosen(members[:1]), begin=take.time[:1], steps=steps)
            controls, measured = self.controls(whole, signals)[0], (take.measured - bias) / gain
            mujoco.mj_resetDataKeyframe(model, data, 0)
            begins = {round((windows.begin[i] - take.time[0]) / step): i for i in members}
            sample, last = 0, -np.inf
            for k in range(steps):
                while sample < len(take.time) and take.time[sample] < take.time[0] + (k + 0.5) * step:
                    pull = 1.0 - np.exp(-(take.time[sample] - last) / memory)
                    position, velocity = data.qpos.copy(), data.qvel.copy()
                    for part, (source, places) in ((position, columns["qpos"]), (velocity, columns["qvel"])):
                        part[places] = np.where(np.isnan(seen := measured[sample, source]), part[places], seen)
                    mujoco.mj_normalizeQuat(model, position)
                    mujoco.mj_differentiatePos(model, change, pull, data.qpos, position)
                    data.qvel += 0.5 * derived * change / memory
                    data.qvel += pull * (velocity - data.qvel)
                    mujoco.mj_integratePos(model, data.qpos, change, pull * pull)
                    last, sample = take.time[sample], sample + 1
                if k in begins:
                    guess[begins[k]] = np.concatenate([data.qpos, data.qvel, data.act])
                data.ctrl[:] = controls[k]
                mujoco.mj_step(model, data)
        return guess

    def predict(
        self, windows: Windows, states: np.ndarray, xs: np.ndarray, changes: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute predictions minus measurements, and the last states.

        Args:
            windows: The windows.
            states: Initial states, (windows, nq + nv + na).
            xs: Hypotheses: coordinates of the parameters, (hypotheses, parameters).
            changes: Changes of the initial states, (1 or windows, hypotheses, nx).

        Returns:
            (windows, hypotheses, samples, columns); missing numbers are 0, and those of diverged worlds are infinite.
            The states after the windows are (windows * hypotheses, nq + nv + na).
        """
        values, signals = ([of(x) for x in xs] for of in (self.parameters.values, self.parameters.signals))
        count, batch = len(xs), Batch(self.model, len(windows) * len(xs), self.nthread)
        for field in self.parameters.touched:
            batch.expand(field)[...] = np.concatenate([np.stack([v[field] for v in values])] * len(windows))
        shifts = np.broadcast_to(changes, (len(windows), count, self.nx)).reshape(-1, self.nx)
        initial = self.moved(np.repeat(states, count, axis=0), shifts)
        parts = np.split(initial, [self.model.nq, self.model.nq + self.model.nv], axis=1)
        state = dict(zip(("qpos", "qvel", "act"), parts, strict=True))
        for name, part in state.items():
            batch.bind(name)[...] = part
        controls = np.stack([self.controls(windows, signal) for signal in signals], axis=1)
        controls = controls.reshape(-1, windows.steps, self.model.nu)
        size = (len(initial), windows.steps)
        records = {name: np.empty((*size, len(getattr(self._data, name)))) for name in self.sources}
        call_batch(batch, batch.set_const)
        call_batch(batch, batch.rollout, windows.steps, controls, record=list(records), out=records)
        for name in state.keys() & records.keys():  # the state before each substep
            records[name] = np.concatenate([state[name][:, None], records[name][:, :-1]], axis=1)
        predicted = np.empty((*size, len(self.log.columns)))
        for name, (columns, indices) in self.sources.items():
            predicted[..., columns] = records[name][..., indices]
        predicted[batch.warning[:, :, 1].any(axis=1)] = np.inf  # a hypothesis may be absurd
        ends = np.concatenate([batch.bind(name) for name in state], axis=1)
        trajectories = predicted.reshape(len(windows), count, windows.steps, -1)
        return self._compared(windows, trajectories, signals), ends

    def moved(self, states: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Add changes (n, nx) to states (n, nq + nv + na)."""
        nq, nv, result = self.model.nq, self.model.nv, states.copy()
        result[:, nq:] += changes[:, nv:]
        for row, change in zip(result, changes, strict=True):
            position = row[:nq].copy()
            mujoco.mj_integratePos(self.model, position, np.ascontiguousarray(change[:nv]), 1.0)
            row[:nq] = position
        return result

    def controls(self, windows: Windows, signals: Signals) -> np.ndarray:
        """Compute the mean of the delayed controls over every substep, (windows, steps, nu)."""
        nu, step = self.model.nu, self.model.opt.timestep
        delay, gain, bias = (signals[name][:nu] for name in ("delay", "gain", "bias"))
        means = np.empty((len(windows), windows.steps, nu))
        for number in np.unique(windows.take):
            (time, integral), members = self._integrals[number], windows.take == number
            edges = windows.begin[members, None] + step * np.arange(windows.steps + 1)
            for i in range(nu):
                means[members, :, i] = np.diff(np.interp(edges - delay[i], time, integral[:, i]), axis=1) / step
        return (means - bias) / gain

    def _compared(self, windows: Windows, predicted: np.ndarray, signals: Sequence[Signals]) -> np.ndarray:
        """Interpolate predictions at the times of the samples, and subtract the measurements."""
        delay, gain, bias = (np.stack([signal[name][self.model.nu :] for signal in signals])[:, None]
                             for name in ("delay", "gain", "bias"))  # fmt: skip
        place = windows.time[:, None, :, None] - delay / self.model.opt.timestep
        place = np.clip(place, 0.0, windows.steps - 1.0)
        low = np.minimum(place.astype(int), windows.steps - 2)
        early, late = (np.take_along_axis(predicted, low + k, axis=2) for k in (0, 1))
        with np.errstate(invalid="ignore"):
            values = gain * (early + (place - low) * (late - early)) + bias
            measured = windows.measured[:, None]
            difference = values - measured
            for quat in self.quats:
                difference[..., quat] = _turn(values[..., quat], measured[..., quat])
            return np.where(np.isnan(measured), 0.0, np.where(np.isfinite(difference), difference, np.inf))


def _quaternions(columns: Sequence[Column], model: mujoco.MjModel) -> list[list[int]]:
    """Find the columns that are whole quaternions."""
    numbers = {(column.field, column.index): i for i, column in enumerate(columns)}
    joints = zip(map(mujoco.mjtJoint, model.jnt_type), model.jnt_qposadr.tolist(), strict=True)
    starts = [("qpos", address + _QUATERNION[kind]) for kind, address in joints if kind in _QUATERNION]
    sensors = np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_FRAMEQUAT)
    starts += [("sensordata", int(model.sensor_adr[i])) for i in sensors]
    groups = [[numbers.get((name, start + k), -1) for k in range(4)] for name, start in starts]
    return [group for group in groups if -1 not in group]


def _turn(predicted: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Compute the rotation from measured to predicted quaternions as a vector in rad, and a zero, (..., 4)."""
    w, v, a, u = predicted[..., :1], predicted[..., 1:], measured[..., :1], measured[..., 1:]
    real, turn = w * a + (v * u).sum(-1, keepdims=True), a * v - w * u - np.cross(u, v)
    return np.concatenate([2.0 * turn / np.where(real == 0.0, 1.0, real), np.zeros_like(real)], axis=-1)
