"""Open-loop roll-outs on the C engine: a whole horizon of every world in one call, which no Python interrupts."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import warp as wp
from mujoco.batch import Batch

from lyceum_warp.fields import STATE_FIELDS, Field, Stage

if TYPE_CHECKING:
    from lyceum_warp.engines.c.mujoco_engine import MujocoEngine


def is_exact(model: mujoco.MjModel, fields: Iterable[Field]) -> bool:
    """Whether the records of ``Batch.rollout`` hold what a call of ``Batch.step`` for each step would show.

    A record is taken as ``mj_step`` leaves things. The state is then the new one, but what was computed from
    positions and velocities belongs to the state before the last substep: it is found in the record of the next.
    RK4 is the exception, where it belongs to an intermediate stage. Sensor data of both kinds can't be told apart.
    """
    current = [field for field in fields if field.refresh > Stage.NONE]
    if any(field.snapshot for field in current):
        return False
    return not current or model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4


class NativeRollout:
    """Rolls out worlds of a C engine, in a batch of its own.

    Args:
        engine: The engine.
        steps: Steps of the horizon.
        nstep: Substeps in a step.
        names: The fields to record, of those that the engine keeps.
    """

    def __init__(self, engine: "MujocoEngine", steps: int, nstep: int, names: Iterable[str]) -> None:
        self.engine, self.nstep = engine, nstep
        self.batch = Batch(engine.native_model, engine.nworld, engine.nthread)
        self.control = np.zeros((engine.nworld, steps * nstep, engine.model.nu))
        self.by_step = self.control.reshape(engine.nworld, steps, nstep, engine.model.nu)
        self._given: Any = None
        self._views: Any = None
        self.fields = [engine.fields[name] for name in names]
        self.stage = max((field.refresh for field in self.fields), default=Stage.NONE)
        self.start: dict[str, slice] = {}
        """Columns of the state vector that hold a field's value at the start."""
        self.final: dict[str, np.ndarray] = {}
        """The values at the end of those fields that have to be computed for it."""
        self.records: dict[Any, np.ndarray] = {}
        column = engine.integration_size
        for field in engine.snapshots:
            self.start[field.name] = slice(column, column + field.size)
            column += field.size
        for field in self.fields:
            if field.name in STATE_FIELDS:
                component = STATE_FIELDS[field.name].value
                size = mujoco.mj_stateSize(engine.model, component)
                first = mujoco.mj_stateSize(engine.model, mujoco.mjtState.mjSTATE_INTEGRATION.value & (component - 1))
                self.start[field.name] = slice(first, first + size)
                self.records[component] = np.zeros((engine.nworld, steps * nstep, size))
            else:
                bound = self.batch.bind(field.name)
                self.records[field.name] = np.zeros((engine.nworld, steps * nstep, *bound.shape[1:]))
                if field.refresh > Stage.NONE:
                    self.final[field.name] = bound

    def __call__(self, state: wp.array, controls: wp.array, records: Mapping[str, wp.array]) -> None:
        """Roll out; see ``Engine.rollout``."""
        given = (state, controls, records)
        if self._given is None or any(a is not b for a, b in zip(given, self._given, strict=True)):
            self._given = given  # the views of Warp's arrays take longer to make than to fill
            self._views = state.numpy(), controls.numpy(), {name: record.numpy() for name, record in records.items()}
        self.run(*self._views)

    def run(self, state: np.ndarray, controls: np.ndarray, targets: Mapping[str, np.ndarray]) -> None:
        """Roll out and record. The engine's worlds are then where the roll-outs ended, with what went wrong in them.

        Args:
            state: States at the start, (nworld, at least state_size) float64.
            controls: Controls of each step, (steps, nworld, nu).
            targets: Where each field goes, (steps + 1, nworld, ...) float32.
        """
        engine = self.engine
        self.batch.state[:] = state[:, : engine.integration_size]
        np.copyto(self.by_step, controls.transpose(1, 0, 2)[:, :, None])
        count, control = self.control.shape[1], self.control
        records: dict[str, Any] = {"record": list(self.records), "out": self.records}
        engine.contained(self.batch.rollout, nstep=count, control=control, **records)
        if self.stage > Stage.NONE:
            engine.contained(self.batch.forward, stage=int(self.stage))
        # a simulation that MuJoCo warns of stops there, and its records repeat: only the warning tells
        engine.batch.state[:] = self.batch.state
        engine.batch.warning += self.batch.warning
        self.batch.warning[:] = 0
        for field in self.fields:
            self._copy(field, state, targets[field.name])

    def _copy(self, field: Field, state: np.ndarray, target: np.ndarray) -> None:
        key = STATE_FIELDS[field.name].value if field.name in STATE_FIELDS else field.name
        record, nstep = self.records[key], self.nstep
        if field.name in self.final:
            # the record after a step's first substep is of the state that the step began with
            values, end = record[:, ::nstep], self.final[field.name]
            np.copyto(target[:-1], values.swapaxes(0, 1).reshape(target[:-1].shape), "unsafe")
            np.copyto(target[-1], end.reshape(target[-1].shape), "unsafe")
        else:
            start, values = state[:, self.start[field.name]], record[:, nstep - 1 :: nstep]
            np.copyto(target[0], start.reshape(target[0].shape), "unsafe")
            np.copyto(target[1:], values.swapaxes(0, 1).reshape(target[1:].shape), "unsafe")
