"""Define a third engine that relies only on the contract in ``engines/base.py``."""

import copy
from collections.abc import Collection, Iterable

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.core.fields import STATE_FIELDS, Field, Stage, state_columns
from lyceum_warp.core.model_fields import ModelField
from lyceum_warp.engines import Engine
from lyceum_warp.kernels import faults, state
from lyceum_warp.support.arrays import flat, launch_rows, launch_worlds, repeated

_SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value


class ToyEngine(Engine):
    """An engine that steps one world at a time, with states in float64 rows.

    Each world has its own MjModel. ``apply_model`` writes the world's fields into this model. ``reset``, ``commit``,
    ``find_faults`` and ``get_state`` only launch Warp kernels, because the launches become graphs.
    """

    name = "toy"
    capturable = False

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        device: wp.Device,
        fields: Iterable[Field],
        dynamics: Iterable[ModelField] = (),
        initial: np.ndarray | None = None,
    ) -> None:
        super().__init__(model, nworld, device, fields, dynamics, initial)
        mujoco.set_mju_user_warning(lambda message: None)
        self.models = [copy.copy(model) for _ in range(nworld)]
        for own in self.models:
            own.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.worlds = [mujoco.MjData(own) for own in self.models]
        rows = np.tile(self.initial, (nworld, 1))
        self._rows = wp.array(rows, dtype=wp.float64, device=device)
        self._initial = wp.array(rows[0].astype(np.float32).astype(float), dtype=wp.float64, device=device)
        for name, varied in self.dynamics.items():
            self.arrays[name] = self._nominal_rows(varied, nworld)
        self._warning = wp.zeros((nworld, len(self.worlds[0].warning.number), 2), dtype=int, device=device)
        self._columns: dict[str, wp.array] = {}
        for name, field in self.fields.items():
            self.arrays[name] = wp.zeros((nworld, *field.shape), dtype=field.dtype, device=device)
            if name in STATE_FIELDS:
                self._columns[name] = self._rows[:, state_columns(model, name)]
        self.ctrl = self.arrays["ctrl"]

    def _load(self, w: int) -> None:
        mujoco.mj_setState(self.models[w], self.worlds[w], self._rows.numpy()[w], _SPEC)

    def _show(self, w: int, fields: list[Field]) -> None:
        for field in fields:
            target = self.arrays[field.name].numpy()[w : w + 1]
            target[...] = np.reshape(getattr(self.worlds[w], field.name), target.shape)

    def _compute(self, w: int, stage: Stage) -> None:
        model, data = self.models[w], self.worlds[w]
        if stage == Stage.ACCELERATION:
            mujoco.mj_forward(model, data)
        elif stage > Stage.NONE:
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_sensorPos(model, data)
            if stage == Stage.VELOCITY:
                mujoco.mj_fwdVelocity(model, data)
                mujoco.mj_sensorVel(model, data)

    def step(self, nstep: int) -> None:
        fields = list(self.fields.values())
        for w, data in enumerate(self.worlds):
            for name, field in self.fields.items():
                if field.written:
                    row = flat(self.arrays[name]).numpy()[w]
                    self._rows.numpy()[w, state_columns(self.model, name)] = row
            self._advance(w, nstep)
            self._show(w, [field for field in fields if field.lagged])
            self._compute(w, self.stage)
            self._show(w, [field for field in fields if not field.lagged])
            self._warning.numpy()[w, :, 1] += data.warning.number
            data.warning.number[:] = 0

    def _advance(self, w: int, nstep: int) -> None:
        self._load(w)
        for _ in range(nstep):
            mujoco.mj_step(self.models[w], self.worlds[w])
        mujoco.mj_getState(self.models[w], self.worlds[w], self._rows.numpy()[w], _SPEC)

    def apply_model(self, mask: wp.array) -> None:
        for w in mask.numpy().nonzero()[0]:
            for name, varied in self.dynamics.items():
                own, world = varied.value(self.model), varied.value(self.models[w])
                given = self.arrays[name].numpy()[w].reshape(own.shape)
                value = np.where(given == own.astype(np.float32), own, given)
                if world.ndim:
                    world[...] = value
                else:
                    setattr(self.models[w].opt, name, float(value))
            mujoco.mj_setConst(self.models[w], mujoco.MjData(self.models[w]))

    def settle(self, mask: wp.array, nstep: int) -> None:
        for w in mask.numpy().nonzero()[0] if nstep else ():
            self._advance(w, nstep)
            self._rows.numpy()[w, state_columns(self.model, "time")] = 0.0
        self._read_state_fields(mask)

    def find_faults(self, mask: wp.array) -> None:
        nphysics = 1 + self.model.nq + self.model.nv + self.model.na
        args = [mask, self._rows, nphysics, self._warning, self.fault]
        launch_worlds(faults.faults_of_rows, self.nworld, args, self.device)

    def reset(self, mask: wp.array) -> None:
        launch_rows(state.copy_rows64, mask, repeated(self._initial, self.nworld), self._rows)
        self._read_state_fields(mask)

    def _read_state_fields(self, mask: wp.array) -> None:
        for name, column in self._columns.items():
            launch_rows(state.narrow, mask, column, flat(self.arrays[name]))

    def commit(self, mask: wp.array, names: Collection[str] | None = None) -> None:
        for name, column in self._columns.items():
            if names is None or name in names:
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

    def _get_integration(self, state_out: wp.array, mask: wp.array) -> None:
        launch_rows(state.copy_rows64, mask, self._rows, state_out)

    def _set_integration(self, state_in: wp.array, mask: wp.array) -> None:
        launch_rows(state.copy_rows64, mask, state_in, self._rows)
