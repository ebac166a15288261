"""Step worlds by MuJoCo itself on a thread pool (mujoco.batch), in float64: the C engine."""

import copy
from collections.abc import Collection, Iterable, Mapping
from functools import partial
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.batch import Batch

from lyceum_warp.core.fields import (
    DERIVED_FIELDS,
    READ_ONLY,
    STATE_FIELDS,
    Field,
    Stage,
    early_sensor_columns,
    state_columns,
)
from lyceum_warp.core.model_fields import ModelField
from lyceum_warp.engines.base import Engine
from lyceum_warp.engines.c.batch_faults import call_batch
from lyceum_warp.engines.c.native_rollout import NativeRollout, is_exact
from lyceum_warp.engines.c.world_models import WorldModels, bytes_per_world as model_bytes_per_world
from lyceum_warp.graphs.capture import Calls, Graphs, Phase
from lyceum_warp.kernels import faults
from lyceum_warp.kernels.state import copy_rows64, narrow_bool, narrow_four, widen, widen_bool, widen_four
from lyceum_warp.support.arrays import flat, launch_rows, launch_several_rows, launch_worlds, repeated
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.support.mujoco_log import quiet
from lyceum_warp.support.validate import whole_number

_BATCH_BYTES = 150
"""The bytes that ``Batch`` stores per world."""

_MOST_MASKS = 16


class MujocoEngine(Engine):
    """Steps worlds in float64 in ``mujoco.batch.Batch``, and copies the batch's fields to float32 arrays.

    The device must be the CPU, and the initial state is rounded to float32. The number of threads is ``nthread``; 0
    means all cores that the process may use.

    Raises:
        ValueError: The device is not the CPU, or ``nthread`` is negative.
    """

    name = "mujoco"
    capturable = False

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        device: wp.Device,
        fields: Iterable[Field],
        dynamics: Iterable[ModelField] = (),
        initial: np.ndarray | None = None,
        *,
        nthread: int = 0,
    ) -> None:
        if not device.is_cpu:
            raise ValueError(
                f"the mujoco engine runs on the CPU, not on {device.alias!r}: use device='cpu' or engine='warp'"
            )
        super().__init__(model, nworld, device, fields, dynamics, initial)
        quiet()
        # MuJoCo's own default ignores the process's affinity: under taskset, many threads would share a few cores
        self.launch_threads = self.nthread = whole_number("nthread", nthread, low=0) or cpu_cores()
        self.native_model = copy.copy(model)
        # autoreset would hide a fault: MuJoCo would silently reset the world within a step
        self.native_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        # A persistent batch, with one MjData per world, could reuse the stages computed after the last step. But it
        # does not fit into the CPU's caches: the six tasks that need such stages were 4 to 33 % slower with 128 and
        # 1,024 worlds on two cores.
        self.batch = Batch(self.native_model, nworld, self.nthread)
        self._rows = self._alias(self.batch.state)
        self._warning: wp.array = wp.array(self.batch.warning, dtype=int, device=device, copy=False)
        self._initial = self._rounded_initial()
        self._sources: dict[str, wp.array] = {}
        self._copies: dict[str, tuple[np.ndarray, np.ndarray]] = {}
        for field in self.fields.values():
            self._bind(field)
        self.ctrl = self.arrays["ctrl"]
        self._order_copies()
        self._graphs = Graphs(device, capture_engine=False)
        self._steps: dict[int, Calls] = {}
        self._rollouts: dict[Any, NativeRollout | None] = {}
        self._masks: dict[int, tuple[wp.array, np.ndarray]] = {}
        self._values: dict[str, np.ndarray] = {}
        for name, varied in self.dynamics.items():
            self.arrays[name] = self._nominal_rows(varied, nworld)
            self._values[name] = flat(self.arrays[name]).numpy()
        self._models = WorldModels(self.batch, self.dynamics.values())
        self._models.apply(self._values)

    def _order_copies(self) -> None:
        """Decide whether derived fields need a ``forward`` after the substeps, and when to copy each field."""
        fields = list(self.fields.values())
        self._inputs = [field for field in fields if field.written]
        self._state_fields = [field for field in fields if field.name in STATE_FIELDS]
        self._derived = [field for field in fields if field.name not in STATE_FIELDS]
        current = [field for field in self._derived if field.refresh > Stage.NONE]
        free = {*(name for name, stage in DERIVED_FIELDS.items() if stage == Stage.POSITION), "cvel"}
        touchless = bool(current) and all(field.name in free for field in current)
        self._apart = touchless or (bool(current) and any(field.lagged for field in fields))
        """Whether a separate call of ``forward`` computes derived fields."""
        # `forward` may replace other fields by values of another world
        before = [field for field in self._derived if field not in current or field.snapshot]
        self._before_forward = before if self._apart else []
        # `forward` updates some of their elements
        self._after_forward = [field for field in self._before_forward if field in current]
        self._after_step = [field for field in fields if field.name != "ctrl" and field not in self._before_forward]
        self._after_part = [field for field in self._after_step if field not in current] + self._before_forward
        # these fields do not depend on contacts, so skip collision detection, the slowest part of the stages
        without = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT.value if touchless else 0
        self._disabled = self.batch.expand("opt.disableflags") if touchless else np.zeros(0, dtype=int)
        self._step_flags, self._forward_flags = self._disabled.copy(), self._disabled | without
        self._early_columns = np.isin(np.arange(self.model.nsensordata), early_sensor_columns(self.model))

    def _on_host(self, mask: wp.array) -> np.ndarray:
        """Return a NumPy view of a mask. Views are cached, because creating a view takes longer than reading it."""
        if (pair := self._masks.get(id(mask))) is None:
            pair = mask, mask.numpy()
            if len(self._masks) < _MOST_MASKS:
                self._masks[id(mask)] = pair  # the dict keeps the mask alive, so its id stays unique
        return pair[1]

    def _alias(self, rows: np.ndarray) -> wp.array:
        return wp.array(rows, dtype=wp.float64, device=self.device, copy=False)

    def start_at(self, initial: np.ndarray) -> None:
        super().start_at(initial)
        wp.copy(self._initial, self._rounded_initial())

    def _rounded_initial(self) -> wp.array:
        initial = self.initial.copy()
        for name in STATE_FIELDS:
            if name in READ_ONLY:
                continue  # rounding would shift the time stamps of delayed sensors
            columns = state_columns(self.model, name)
            initial[columns] = initial[columns].astype(np.float32)
        return wp.array(initial, dtype=wp.float64, device=self.device)

    def _bind(self, field: Field) -> None:
        array = wp.zeros((self.nworld, *field.shape), dtype=field.dtype, device=self.device)
        self.arrays[field.name] = array
        if field.name in STATE_FIELDS:
            source = self.batch.state[:, state_columns(self.model, field.name)]
        else:
            source = self.batch.bind(field.name).reshape(self.nworld, -1)
        self._sources[field.name] = self._alias(source)
        target = array.numpy()
        self._copies[field.name] = target, source.reshape(target.shape)

    @classmethod
    def bytes_per_world(
        cls, model: mujoco.MjModel, fields: Iterable[Field], dynamics: Iterable[ModelField] = (), **options: Any
    ) -> int:
        fields, dynamics = list(fields), list(dynamics)
        total = super().bytes_per_world(model, fields, dynamics, **options) + _BATCH_BYTES
        if dynamics:
            total += model_bytes_per_world(model, dynamics)
        total += 8 * sum(field.size for field in fields if field.name not in STATE_FIELDS)
        return total

    # physics

    def step(self, nstep: int) -> None:
        if nstep not in self._steps:
            self._steps[nstep] = self._graphs.sequence(self.step_phases(nstep))
        for call in self._steps[nstep]:
            call()

    def step_phases(self, nstep: int, *, first: bool = True, last: bool = True, rendered: bool = False) -> list[Phase]:
        fields = self._after_step if last else self._after_part
        return [
            Phase("inputs", self._take_inputs, by_world=True),
            Phase("physics", partial(self._advance, nstep, last), engine=True),
            Phase("fields", partial(self._read, fields, self._everyone), by_world=True),
        ]

    def _take_inputs(self) -> None:
        for field in self._inputs:
            launch_rows(widen, self._everyone, flat(self.arrays[field.name]), self._sources[field.name])

    def _advance(self, nstep: int, last: bool) -> None:
        stage = self.stage if last and not self._apart else Stage.NONE
        call_batch(self.batch, self.batch.step, nstep=nstep, stage=stage)
        if last and self._apart:
            self._copy(self._before_forward)
            self._disabled[...] = self._forward_flags
            try:
                call_batch(self.batch, self.batch.forward, stage=self.stage)
            finally:
                self._disabled[...] = self._step_flags
            self._copy(self._after_forward, early=True)

    def _copy(self, fields: list[Field], mask: np.ndarray | None = None, *, early: bool = False) -> None:
        """Copy the masked worlds' fields into float32 arrays.

        If ``early`` is set, sensors of the acceleration stage are not copied.
        """
        with np.errstate(over="ignore"):  # numbers in worlds with faults may overflow
            for field in fields:
                target, source = self._copies[field.name]
                where: Any = True if mask is None else mask.reshape(-1, *[1] * (target.ndim - 1))
                if early and field.name == "sensordata":
                    where = where & self._early_columns
                np.copyto(target, source, "unsafe", where=where)

    def rollout(self, state: wp.array, controls: wp.array, nstep: int, buffers: Mapping[str, wp.array]) -> None:
        key = (len(controls), nstep, *buffers)
        if key not in self._rollouts:
            fields = [self.fields[name] for name in buffers if name not in self.dynamics]
            self._rollouts[key] = None
            if is_exact(self.model, fields):
                batch, dynamics = Batch(self.native_model, self.nworld, self.nthread), self.dynamics.values()
                self._rollouts[key] = NativeRollout(batch, len(controls), nstep, fields, self.snapshots, dynamics)
        native = self._rollouts[key]
        if native is None:
            super().rollout(state, controls, nstep, buffers)
            return
        native.run(state, controls, buffers)
        self.batch.state[:] = native.batch.state
        self.batch.warning += native.batch.warning
        self._copy(self._state_fields)
        self._set_dynamics(state, self._everyone)
        for name in self.dynamics.keys() & buffers.keys():
            np.copyto(buffers[name].numpy(), self.arrays[name].numpy())

    def rollout_bytes_per_world(self, steps: int, nstep: int, fields: Iterable[Field]) -> int:
        fields = list(fields)
        if not is_exact(self.model, fields):
            return 0
        return 8 * steps * nstep * (self.model.nu + sum(field.size for field in fields)) + 8 * self.integration_size

    def apply_model(self, mask: wp.array) -> None:
        self._models.apply(self._values, self._on_host(mask))

    def settle(self, mask: wp.array, nstep: int) -> None:
        worlds = self._on_host(mask)
        if nstep == 0 or not worlds.any():
            return
        call_batch(self.batch, self.batch.step, ids=worlds, nstep=nstep)
        self.batch.state[worlds, state_columns(self.model, "time")] = 0.0
        self._copy(self._state_fields, worlds)

    def find_faults(self, mask: wp.array) -> None:
        nphysics = 1 + self.model.nq + self.model.nv + self.model.na
        args = [mask, self._rows, nphysics, self._warning, self.fault]
        launch_worlds(faults.faults_of_rows, self.nworld, args, self.device)

    def reset(self, mask: wp.array) -> None:
        launch_rows(copy_rows64, mask, repeated(self._initial, self.nworld), self._rows)
        self._read(self._state_fields, mask)

    def _read(self, fields: Iterable[Field], mask: wp.array) -> None:
        numbers = []
        for field in fields:
            array, source = self.arrays[field.name], self._sources[field.name]
            if array.dtype is wp.bool:
                launch_rows(narrow_bool, mask, source, array)
            else:
                numbers.append((source, flat(array)))
        launch_several_rows(narrow_four, mask, numbers)

    def commit(self, mask: wp.array, names: Collection[str] | None = None) -> None:
        numbers = []
        for field in self._state_fields:
            if names is not None and field.name not in names:
                continue
            array, column = self.arrays[field.name], self._sources[field.name]
            if array.dtype is wp.bool:
                launch_rows(widen_bool, mask, array, column)
            elif field.name not in READ_ONLY:
                numbers.append((flat(array), column))
        launch_several_rows(widen_four, mask, numbers)

    def refresh(self, mask: wp.array) -> None:
        self._forward(mask, self.reset_stage, [field for field in self._derived if field.reset > Stage.NONE])

    def refresh_current(self, mask: wp.array) -> None:
        current = [field for field in self._derived if field.refresh > Stage.NONE]
        self._forward(mask, self.stage, current, early=True)
        self._read(self._state_fields, mask)

    def _forward(self, mask: wp.array, stage: Stage, fields: list[Field], *, early: bool = False) -> None:
        worlds = self._on_host(mask)
        if stage > Stage.NONE and worlds.any():
            call_batch(self.batch, self.batch.forward, ids=worlds, stage=stage)
            self._copy(fields, worlds, early=early)

    # state

    def _get_integration(self, state_out: wp.array, mask: wp.array) -> None:
        launch_rows(copy_rows64, mask, self._rows, state_out)

    def _set_integration(self, state_in: wp.array, mask: wp.array) -> None:
        launch_rows(copy_rows64, mask, state_in, self._rows)
