"""A third engine, written against the contract in ``lyceum_warp.engines.base`` alone: an MjData for each world."""

import copy
from collections.abc import Iterable

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.arrays import flat, launch_rows
from lyceum_warp.engines.base import Engine
from lyceum_warp.fields import STATE_FIELDS, Field, Stage, state_columns
from lyceum_warp.kernels import faults, state

_SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value


class ToyEngine(Engine):
    """The state lies in float64 rows; a step loads each row into its world's MjData and saves it afterwards.

    Launches between two calls of the engine are captured, so ``reset``, ``commit``, ``find_faults`` and getting the
    state are Warp launches on those rows.
    """

    name = "toy"
    capturable = False

    def __init__(self, model: mujoco.MjModel, nworld: int, device: wp.Device, fields: Iterable[Field]) -> None:
        super().__init__(model, nworld, device, fields)
        mujoco.set_mju_user_warning(lambda message: None)
        self._model = copy.copy(model)
        self._model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.worlds = [mujoco.MjData(self._model) for _ in range(nworld)]
        rows = np.empty((nworld, self.integration_size))
        for data, row in zip(self.worlds, rows, strict=True):
            mujoco.mj_getState(self._model, data, row, _SPEC)
        self._rows = wp.array(rows, dtype=wp.float64, device=device)
        self._initial = wp.array(rows[0].astype(np.float32).astype(float), dtype=wp.float64, device=device)
        self._warning = wp.zeros((nworld, len(self.worlds[0].warning.number), 2), dtype=int, device=device)
        self._columns: dict[str, wp.array] = {}
        for name, field in self.fields.items():
            self.arrays[name] = wp.zeros((nworld, *field.shape), dtype=field.dtype, device=device)
            if name in STATE_FIELDS:
                self._columns[name] = self._rows[:, state_columns(model, name)]
        self.ctrl = self.arrays["ctrl"]

    # fields

    def _load(self, w: int) -> None:
        mujoco.mj_setState(self._model, self.worlds[w], self._rows.numpy()[w], _SPEC)

    def _show(self, w: int, fields: list[Field]) -> None:
        for field in fields:
            target = self.arrays[field.name].numpy()[w : w + 1]
            target[...] = np.reshape(getattr(self.worlds[w], field.name), target.shape)

    def _compute(self, w: int, stage: Stage) -> None:
        model, data = self._model, self.worlds[w]
        if stage == Stage.ACCELERATION:
            mujoco.mj_forward(model, data)
        elif stage > Stage.NONE:
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_sensorPos(model, data)
            if stage == Stage.VELOCITY:
                mujoco.mj_fwdVelocity(model, data)
                mujoco.mj_sensorVel(model, data)

    # physics

    def step(self, nstep: int) -> None:
        fields = list(self.fields.values())
        for w, data in enumerate(self.worlds):
            self._load(w)
            data.ctrl[:] = self.ctrl.numpy()[w]
            for _ in range(nstep):
                mujoco.mj_step(self._model, data)
            mujoco.mj_getState(self._model, data, self._rows.numpy()[w], _SPEC)
            self._show(w, [field for field in fields if field.lagged])
            self._compute(w, self.stage)
            self._show(w, [field for field in fields if not field.lagged])
            self._warning.numpy()[w, :, 1] += data.warning.number
            data.warning.number[:] = 0

    def find_faults(self, mask: wp.array) -> None:
        nphysics = 1 + self.model.nq + self.model.nv + self.model.na
        wp.launch(faults.faults_of_rows, self.nworld, [mask, self._rows, nphysics, self._warning, self.fault])

    def reset(self, mask: wp.array) -> None:
        launch_rows(state.fill_rows64, mask, self._initial, self._rows)
        self._read_state_fields(mask)

    def _read_state_fields(self, mask: wp.array) -> None:
        for name, column in self._columns.items():
            launch_rows(state.narrow, mask, column, flat(self.arrays[name]))

    def commit(self, mask: wp.array) -> None:
        for name, column in self._columns.items():
            launch_rows(state.widen, mask, flat(self.arrays[name]), column)

    def refresh(self, mask: wp.array) -> None:
        self._forward(mask, self.reset_stage, list(self.fields.values()))

    def refresh_current(self, mask: wp.array) -> None:
        self._forward(mask, self.stage, [field for field in self.fields.values() if not field.snapshot])
        self._read_state_fields(mask)

    def _forward(self, mask: wp.array, stage: Stage, fields: list[Field]) -> None:
        for w in mask.numpy().nonzero()[0]:
            self._load(w)
            self._compute(w, stage)
            self._show(w, [field for field in fields if field.name not in STATE_FIELDS])

    # state

    def _get_integration(self, state_out: wp.array, mask: wp.array) -> None:
        launch_rows(state.copy_rows64, mask, self._rows, state_out)

    def _set_integration(self, state_in: wp.array, mask: wp.array) -> None:
        launch_rows(state.copy_rows64, mask, state_in, self._rows)
