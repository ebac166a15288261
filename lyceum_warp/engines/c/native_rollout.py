"""Roll out the whole horizon of every world in one native call."""

from collections.abc import Iterable, Mapping
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.batch import Batch

from lyceum_warp.core.fields import STATE_FIELDS, Field, Stage, state_columns
from lyceum_warp.core.model_fields import ModelField
from lyceum_warp.engines.c.batch_faults import call_batch
from lyceum_warp.engines.c.world_models import WorldModels


def is_exact(model: mujoco.MjModel, fields: Iterable[Field]) -> bool:
    """Whether ``Batch.rollout`` returns exactly the same values as a loop of ``Batch.step``.

    ``Batch.rollout`` returns values from MjData after each ``mj_step``. The returned state is the state after the
    substep. MuJoCo has computed all other quantities from the state before the substep or, with RK4, from an
    intermediate state. Sensor data come from several stages, so a native rollout cannot return them exactly.
    """
    current = [field for field in fields if field.refresh > Stage.NONE]
    if any(field.snapshot for field in current):
        return False
    return not current or model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4


class NativeRollout:
    """Rolls out the worlds of a batch, and leaves the final states in the batch.

    ``bind`` must not have been called on this batch. A state vector consists of the integration state, the snapshots
    and the model fields, in this order.
    """

    def __init__(
        self,
        batch: Batch,
        steps: int,
        nstep: int,
        fields: Iterable[Field],
        snapshots: Iterable[Field],
        dynamics: Iterable[ModelField] = (),
    ) -> None:
        self.batch, self.nstep = batch, nstep
        model, nworld = batch.model, batch.nsim
        self.control = np.zeros((nworld, steps * nstep, model.nu))
        self.by_step = self.control.reshape(nworld, steps, nstep, model.nu)
        self.fields = [field for field in fields if field.size]
        self.stage = max((field.refresh for field in self.fields), default=Stage.NONE)
        self.start: dict[str, slice] = {}
        self.final: dict[str, np.ndarray] = {}
        """The results of a forward pass for the final states."""
        self.rows: dict[Any, np.ndarray] = {}
        """The outputs of ``Batch.rollout``, with one row per substep."""
        column = batch.nstate
        for field in snapshots:
            self.start[field.name] = slice(column, column + field.size)
            column += field.size
        self.models = WorldModels(batch, dynamics)
        self.model_columns: dict[str, slice] = {}
        for varied in dynamics:
            self.model_columns[varied.name] = slice(column, column + varied.size)
            column += varied.size
        for field in self.fields:
            if field.name in STATE_FIELDS:
                columns = state_columns(model, field.name)
                self.start[field.name] = columns
                size = columns.stop - columns.start
                self.rows[STATE_FIELDS[field.name].value] = np.zeros((nworld, steps * nstep, size))
            else:
                bound = batch.bind(field.name)
                self.rows[field.name] = np.zeros((nworld, steps * nstep, *bound.shape[1:]))
                if field.refresh > Stage.NONE:
                    self.final[field.name] = bound
        self._outputs: dict[str, Any] = {"record": list(self.rows), "out": self.rows}

    def run(self, initial: wp.array, controls: wp.array, buffers: Mapping[str, wp.array]) -> None:
        """Roll out the worlds. For the arguments, see ``Engine.rollout``. ``batch.warning`` counts the warnings."""
        batch, state = self.batch, initial.numpy()
        batch.state[:] = state[:, : batch.nstate]
        batch.warning[:] = 0
        if self.model_columns:
            self.models.apply({name: state[:, part].astype(np.float32) for name, part in self.model_columns.items()})
        np.copyto(self.by_step, controls.numpy().transpose(1, 0, 2)[:, :, None])
        # MuJoCo stops a world after a warning, and repeats its last row
        call_batch(batch, batch.rollout, nstep=self.control.shape[1], control=self.control, **self._outputs)
        if self.stage > Stage.NONE:
            call_batch(batch, batch.forward, stage=self.stage)
        with np.errstate(over="ignore"):  # numbers in worlds with faults may overflow
            for field in self.fields:
                self._copy(field, state, buffers[field.name].numpy())

    def _copy(self, field: Field, state: np.ndarray, target: np.ndarray) -> None:
        key = STATE_FIELDS[field.name].value if field.name in STATE_FIELDS else field.name
        rows, nstep = self.rows[key], self.nstep
        if field.name in self.final:
            # the row of a step's first substep has the values before the step
            values, end = rows[:, ::nstep], self.final[field.name]
            np.copyto(target[:-1], values.swapaxes(0, 1).reshape(target[:-1].shape), "unsafe")
            np.copyto(target[-1], end.reshape(target[-1].shape), "unsafe")
        else:
            start, values = state[:, self.start[field.name]], rows[:, nstep - 1 :: nstep]
            np.copyto(target[0], start.reshape(target[0].shape), "unsafe")
            np.copyto(target[1:], values.swapaxes(0, 1).reshape(target[1:].shape), "unsafe")
