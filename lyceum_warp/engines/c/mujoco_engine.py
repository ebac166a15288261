"""The C engine: MuJoCo itself, many worlds on a pool of threads (mujoco.batch), float64 inside."""

import copy
import logging
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.batch import Batch, SimulationError

from lyceum_warp.arrays import flat, launch_rows
from lyceum_warp.engines.base import Engine
from lyceum_warp.engines.c.native_rollout import NativeRollout, is_exact
from lyceum_warp.engines.memory import Footprint, check_fit
from lyceum_warp.fields import STATE_FIELDS, Field, Stage
from lyceum_warp.kernels import faults
from lyceum_warp.kernels.state import copy_rows64, fill_rows64, narrow, widen
from lyceum_warp.mujoco_log import quiet

log = logging.getLogger(__name__)


# a world in trouble may hold more than a float32 does
_overflow_ignored = np.errstate(over="ignore")

_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION.value

# where errors are counted as well: a kind of warning that no other done reason stands for
_OTHER_WARNING = mujoco.mjtWarning.mjWARN_INERTIA.value


class MujocoEngine(Engine):
    """Worlds as rows of float64 state in ``mujoco.batch.Batch``, with float32 copies for whoever asked.

    Args:
        model: The compiled model.
        nworld: Number of worlds.
        device: Must be the CPU.
        nthread: Threads of the pool; 0 takes all cores.

    Raises:
        ValueError: The device is not the CPU, or so many worlds do not fit into memory.
    """

    name = "mujoco"
    recordable = False

    def __init__(self, model: mujoco.MjModel, nworld: int, device: wp.Device, *, nthread: int = 0) -> None:
        if not device.is_cpu:
            raise ValueError(
                f"the mujoco engine runs on the CPU, not on {device.alias!r}: use device='cpu' or engine='warp'"
            )
        row = 8 * mujoco.mj_stateSize(model, _INTEGRATION)
        check_fit(Footprint(0, row), nworld, device)
        super().__init__(model, nworld, device)
        quiet()
        self.native_model = copy.copy(model)
        """The model as the batches run it."""
        # a world in trouble is to be seen, not silently reset in the middle of a step
        self.native_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.nthread = nthread
        self._rollouts: dict[Any, NativeRollout | None] = {}
        self._open(persistent=False)
        self.ctrl = self.field("ctrl")

    def _open(self, *, persistent: bool) -> None:
        self.batch = Batch(self.native_model, self.nworld, self.nthread, persistent)
        # as the float32 fields show it, so that who asked for which fields makes no difference
        initial = self.batch.state[0].astype(np.float32).astype(np.float64)
        self._initial: wp.array = wp.array(initial, dtype=wp.float64, device=self.device)
        self._rows = self._alias(self.batch.state)
        self._warning: wp.array = wp.array(self.batch.warning, dtype=int, device=self.device, copy=False)
        self._copies: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        self._columns: dict[str, wp.array] = {}

    def _alias(self, rows: np.ndarray) -> wp.array:
        return wp.array(rows, dtype=wp.float64, device=self.device, copy=False)

    @property
    def hidden_bytes(self) -> int:
        """Without what MuJoCo's arenas hold, which grows with a world's contacts."""
        data = mujoco.MjData(self.model)
        return self.nworld * int(data.nbuffer) if self.batch.persistent else 0

    # fields

    def _bind(self, field: Field) -> wp.array:
        if field.refresh > Stage.NONE and not self.batch.persistent:
            # with an MjData for each world, the next step goes on from what was computed for this one
            previous, old_stage = self.batch.state.copy(), self.stage
            self._open(persistent=True)
            self.batch.state[:] = previous
            for known in self.fields.values():
                self._connect(known)
            if old_stage > Stage.NONE:
                self.contained(self.batch.forward, stage=int(old_stage))
        array = wp.zeros((self.nworld, *field.shape), dtype=field.dtype, device=self.device)
        self.arrays[field.name] = array
        self._connect(field)
        if field.reset > Stage.NONE:
            self.contained(self.batch.forward, stage=int(field.reset))
        self._copy(field)
        return array

    def _connect(self, field: Field) -> None:
        """Find the engine's own float64 array behind a field."""
        if field.name in STATE_FIELDS:
            component = STATE_FIELDS[field.name].value
            start = mujoco.mj_stateSize(self.model, _INTEGRATION & (component - 1))
            source = self.batch.state[:, start : start + mujoco.mj_stateSize(self.model, component)]
            self._columns[field.name] = self._alias(source)
        else:
            source = self.batch.bind(field.name)
        target = self.arrays[field.name].numpy()
        self._copies[field.name] = target, source.reshape(target.shape)

    def _copy(self, field: Field, mask: np.ndarray | None = None) -> None:
        target, source = self._copies[field.name]
        if mask is None:
            np.copyto(target, source, "unsafe")
        else:
            np.copyto(target, source, "unsafe", where=mask.reshape(-1, *[1] * (target.ndim - 1)))

    # physics

    def contained(self, call: Callable[..., None], **arguments: Any) -> None:
        """Run a call that may fail in some worlds: MuJoCo leaves those as they were and finishes the others."""
        try:
            call(**arguments)
        except SimulationError as error:
            log.debug("MuJoCo: %s", error)
            self.batch.warning[error.ids, _OTHER_WARNING, 1] += 1

    @_overflow_ignored
    def step(self, nstep: int) -> None:
        ctrl, rows = self._copies["ctrl"]
        np.copyto(rows, ctrl)
        stage = self.stage
        lagged = [field for field in self.fields.values() if field.lagged]
        if lagged and stage > Stage.NONE:
            self.contained(self.batch.step, nstep=nstep)
            for field in lagged:
                self._copy(field)
            self.contained(self.batch.forward, stage=int(stage))
        else:
            self.contained(self.batch.step, nstep=nstep, stage=int(stage))
            for field in lagged:
                self._copy(field)
        for field in self.fields.values():
            if not field.lagged and field.name != "ctrl":
                self._copy(field)

    @_overflow_ignored
    def rollout(self, state: wp.array, controls: wp.array, nstep: int, records: Mapping[str, wp.array]) -> None:
        key = (len(controls), nstep, *records)
        if key not in self._rollouts:
            exact = is_exact(self.model, [self.fields[name] for name in records])
            self._rollouts[key] = NativeRollout(self, len(controls), nstep, records) if exact else None
        native = self._rollouts[key]
        if native is None:
            super().rollout(state, controls, nstep, records)
        else:
            native(state, controls, records)

    def find_faults(self, mask: wp.array) -> None:
        nphysics = 1 + self.model.nq + self.model.nv + self.model.na
        args = [mask, self._rows, nphysics, self._warning, self.fault]
        wp.launch(faults.faults_of_rows, self.nworld, args, device=self.device)

    def reset(self, mask: wp.array) -> None:
        launch_rows(fill_rows64, mask, self._initial, self._rows)
        for name, column in self._columns.items():
            launch_rows(narrow, mask, column, flat(self.arrays[name]))

    def commit(self, mask: wp.array) -> None:
        for name, column in self._columns.items():
            launch_rows(widen, mask, flat(self.arrays[name]), column)

    def refresh(self, mask: wp.array) -> None:
        self._forward(mask, self.reset_stage, list(self.fields.values()))

    def _refresh_current(self, mask: wp.array) -> None:
        current = [field for field in self.fields.values() if not field.snapshot]
        self._forward(mask, self.stage, current)
        for name, column in self._columns.items():
            launch_rows(narrow, mask, column, flat(self.arrays[name]))

    @_overflow_ignored
    def _forward(self, mask: wp.array, stage: Stage, fields: list[Field]) -> None:
        chosen = mask.numpy()
        if stage > Stage.NONE and chosen.any():
            self.contained(self.batch.forward, ids=chosen, stage=int(stage))
            for field in fields:
                if field.name not in STATE_FIELDS:
                    self._copy(field, chosen)

    # state

    def _get_integration(self, state_out: wp.array, mask: wp.array) -> None:
        launch_rows(copy_rows64, mask, self._rows, state_out)

    def _set_integration(self, state_in: wp.array, mask: wp.array) -> None:
        launch_rows(copy_rows64, mask, state_in, self._rows)
