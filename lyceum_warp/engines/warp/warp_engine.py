"""Step worlds by MuJoCo Warp in float32, on a CUDA device or on the CPU: the Warp engine."""

import contextlib
import copy
from collections.abc import Callable, Collection, Iterable, Iterator
from functools import partial
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from lyceum_warp.core.fields import Field, Stage, early_sensor_columns
from lyceum_warp.core.model_fields import OBJECT_FIELDS, ModelField
from lyceum_warp.engines.base import Engine
from lyceum_warp.engines.warp import forward, sizes, varied_model
from lyceum_warp.engines.warp.forward import Part, PartialForward, forward_parts
from lyceum_warp.engines.warp.group import Conditional, group_size
from lyceum_warp.engines.warp.sizes import data_bytes, probe_sizes, warn_of_unknown_sizes
from lyceum_warp.graphs.capture import Phase
from lyceum_warp.kernels import faults
from lyceum_warp.kernels.state import copy_columns, copy_rows, narrow, widen, zero_columns
from lyceum_warp.support.arrays import alias, flat, launch_rows, repeated
from lyceum_warp.support.upstream import has_sdf_functions, quicken_mujoco_warp

_SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value

quicken_mujoco_warp()


class WarpEngine(Engine):
    """Steps worlds with MuJoCo Warp, and exposes MuJoCo Warp's arrays without a copy.

    Args:
        model, nworld, fields: See ``Engine``.
        device: A CUDA device, or the CPU, which uses a single thread and is for tests.
        dynamics: The model fields that differ between worlds. Contact and constraint capacities are measured with the
            model's own values; see ``sizes.probe_sizes``.
        initial: The initial state for ``reset``, rounded to float32; None for the model's initial state.
        nconmax: Contact capacity, as an average per world. By default, it is measured in random rollouts. The engine
            then adds room for the contacts of a single world whose geoms all touch.
        njmax: Constraint capacity of each world. By default, it is measured in random rollouts.

    Raises:
        ValueError: MuJoCo Warp does not support the model, or an option is out of range.
    """

    name = "warp"
    capturable = True

    partial_refresh = True
    """Whether a forward pass after restarts computes only the restarting worlds."""

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        device: wp.Device,
        fields: Iterable[Field],
        dynamics: Iterable[ModelField] = (),
        initial: np.ndarray | None = None,
        *,
        nconmax: int | None = None,
        njmax: int | None = None,
    ) -> None:
        super().__init__(model, nworld, device, fields, dynamics, initial)
        self.nconmax, self.njmax = _sizes(model, nconmax, njmax, self.dynamics.values())
        if None in (nconmax, njmax):
            drawn = [field.name for field in self.dynamics.values() if field.rows is None]
            warn_of_unknown_sizes(drawn, self.nconmax, self.njmax)
        with refusals():
            self.m = self._put_model()
            self.spare = _contacts_of_one_world(self.m) if nconmax is None else 0
            self.d = self._make_data(nworld)
        with wp.ScopedDevice(device):
            self._state = wp.zeros((nworld, self.integration_size), dtype=float)
            self._history = wp.zeros_like(self.d.history)
        self._views: dict[str, wp.array] = {}
        for field in self.fields.values():
            self._views[field.name] = self._alias(field)
            self.arrays[field.name] = wp.clone(self._views[field.name]) if field.snapshot else self._views[field.name]
        self.ctrl = self.arrays["ctrl"]
        for varied in self.dynamics.values():
            self.arrays[varied.name] = self._alias_model(varied)
        self._static = varied_model.StaticGeoms(model, self.dynamics, device)
        self._constants = self._model_constants()
        # from these model fields, MuJoCo Warp would derive a different initial state for each world
        self._start: wp.array | None = None
        if initial is not None or model.nhistory or self.dynamics.keys() & {"qpos0", "body_pos", "body_quat"}:
            self._start = wp.array(self.initial, dtype=float, device=device)
        self._reset = [field.name for field in self.fields.values() if field.reset > Stage.NONE]
        current = [field.name for field in self.fields.values() if field.refresh > Stage.NONE]
        self._current_parts = forward_parts(model, current)
        needs_all = self.reset_stage == Stage.ACCELERATION
        self._reset_parts = None if needs_all else forward_parts(model, self._reset)
        self._columns: wp.array = wp.array(early_sensor_columns(model), dtype=int, device=device)
        # the parts that the next step can skip, because the last step or restart has computed them
        self._moves_mocap = any(field.written and "mocap" in name for name, field in self.fields.items())
        current_parts = () if self._moves_mocap else self._current_parts or ()
        self._shared = tuple(part for part in current_parts if part in forward.SKIPPED)
        self._conditional = Conditional(device)
        # if a reset needs no collisions, its parts are cheaper in all worlds than in a group
        self._partial = self._group_of_worlds() if self._is_partial() and self._reset_parts is None else None
        if self._current_parts and self._partial is None:
            fields = [field for field in self.snapshots if field.reset > Stage.NONE]
            self.refreshes_all = self._reset_parts == self._current_parts and not fields
        self._settling: PartialForward | None = None
        self.apply_model(self._everyone)

    # hooks for subclasses

    def _put_model(self) -> mjw.Model:
        with wp.ScopedDevice(self.device):
            model = varied_model.put_varied_model(self.model, list(self.dynamics.values()), self.nworld)
        # each world reports its overflows; messages printed by kernels could fill the disk
        model.opt.warn_overflow = 0
        return model

    def _on_device(self) -> contextlib.AbstractContextManager[object]:
        return wp.ScopedDevice(self.device)

    def bare(self) -> tuple[mjw.Model, mjw.Data]:
        """Make another Data of the same size, and a Model with this engine's arrays, to benchmark MuJoCo Warp alone."""
        model = copy.copy(self.m)
        model.opt, model.callback = copy.copy(self.m.opt), copy.copy(self.m.callback)
        return model, self._make_data(self.nworld)

    # memory

    def _make_data(self, nworld: int) -> mjw.Data:
        with wp.ScopedDevice(self.device):
            naconmax = nworld * self.nconmax + self.spare
            return mjw.make_data(self.model, nworld=nworld, naconmax=naconmax, njmax=self.njmax)

    @classmethod
    def bytes_per_world(
        cls, model: mujoco.MjModel, fields: Iterable[Field], dynamics: Iterable[ModelField] = (), **options: Any
    ) -> int:
        dynamics = list(dynamics)
        sizes = _sizes(model, options.get("nconmax"), options.get("njmax"), dynamics)
        with refusals():
            data = data_bytes(model, *sizes)
        floats = mujoco.mj_stateSize(model, _SPEC) + sum(field.size for field in fields if field.snapshot)
        floats += 2 * sum(field.size for field in dynamics)
        floats += sum(np.size(getattr(model, name)) for name in varied_model.outputs_of(dynamics))
        return data + 4 * floats

    # fields

    def _alias_model(self, field: ModelField) -> wp.array:
        if field.name in OBJECT_FIELDS:  # ``apply_model`` copies them into the model
            return self._nominal_rows(field, self.nworld)
        source = getattr(varied_model.owner(self.m, field.name), field.name)
        if not field.size:
            return wp.zeros((self.nworld, *field.shape), dtype=field.dtype, device=self.device)
        return alias(source, field.dtype, (self.nworld, *field.shape))

    def _model_constants(self) -> varied_model.ModelConstants | None:
        fields = [field for field in self.dynamics.values() if field.size and varied_model.constants_of([field])]
        if not fields:
            return None
        loop = self.partial_refresh
        return varied_model.ModelConstants(
            self.model, self.m, fields, self._static, self.nworld, self.device, loop=loop
        )

    def _alias(self, field: Field) -> wp.array:
        """Return a view of a field's memory. MuJoCo Warp's types differ only in name."""
        return alias(getattr(self.d, field.name), field.dtype, (self.nworld, *field.shape))

    def _copy_snapshots(self, mask: wp.array, fields: Iterable[Field]) -> None:
        for field in fields:
            launch_rows(copy_rows, mask, flat(self._views[field.name]), flat(self.arrays[field.name]))

    # physics

    def step(self, nstep: int, *, first: bool = True, last: bool = True, rendered: bool = False) -> None:
        done = {*(self._shared if first else ()), *(forward.POSES if rendered and not self._moves_mocap else ())}
        with self._on_device():
            for i in range(nstep):
                forward.step(self.m, self.d, () if i else done)
        self._copy_snapshots(self._everyone, self.snapshots)
        if last:
            self.refresh_current(self._everyone)

    def step_phases(self, nstep: int, *, first: bool = True, last: bool = True, rendered: bool = False) -> list[Phase]:
        return [Phase("physics", partial(self.step, nstep, first=first, last=last, rendered=rendered), engine=True)]

    def pose(self) -> None:
        """Compute the poses that pictures show, in the current states of all worlds, by Warp launches only."""
        self._forward([part for part in forward.POSES if part not in self._shared], Stage.POSITION)

    def _forward(
        self, parts: Collection[Part] | None, stage: Stage, data: mjw.Data | None = None, model: mjw.Model | None = None
    ) -> None:
        """Run parts of a forward pass in every world of a Data. By default, run all parts up to ``stage``."""
        m, d = self.m if model is None else model, self.d if data is None else data
        with self._on_device():
            if parts is not None:
                for part in parts:
                    part(m, d)
            elif stage == Stage.ACCELERATION:
                forward.forward(m, d)
            else:
                # MuJoCo Warp writes limit and contact sensors only while the limit or contact is active
                wp.launch(zero_columns, (d.nworld, len(self._columns)), [self._columns, d.sensordata])
                forward.positions(m, d)
                mjw.sensor_pos(m, d)
                if stage == Stage.VELOCITY:
                    mjw.fwd_velocity(m, d)
                    mjw.sensor_vel(m, d)
                if "energy" in self.fields:  # no sensor of the model computes this field
                    mjw.energy_pos(m, d)
                    mjw.energy_vel(m, d)

    def refresh_current(self, mask: wp.array) -> None:
        if self.stage == Stage.NONE:
            return
        with self._histories_kept():
            self._forward(self._current_parts, self.stage)
        if (mixed := self.fields.get("sensordata")) and mixed.snapshot and not mixed.lagged:
            args = [mask, self._columns, self._views["sensordata"], self.arrays["sensordata"]]
            wp.launch(copy_columns, (self.nworld, len(self._columns)), args, device=self.device)

    def apply_model(self, mask: wp.array) -> None:
        with self._on_device():
            varied_model.set_meshes(self.m, self.arrays, self.model.nmesh, mask)
            if self._constants is not None:
                self._constants(mask)
            self._static.place(self.m, self.d, mask)

    def settle(self, mask: wp.array, nstep: int) -> None:
        if nstep == 0:
            return
        if self._is_partial():
            self._settling = self._settling or self._partial or self._group_of_worlds()
            with self._on_device():
                self._settling.settle(mask, nstep)
            return
        self._settle_among_all(mask, nstep)

    def _settle_among_all(self, mask: wp.array, nstep: int) -> None:
        """Step all worlds, and restore the state of worlds outside the mask."""
        states, bits = wp.empty_like(self._state), wp.clone(self.d.overflow)
        with self._on_device():
            mjw.get_state(self.m, self.d, states, _SPEC)
            for _ in range(nstep):
                forward.step(self.m, self.d)
            mjw.get_state(self.m, self.d, states, _SPEC, mask)
            launch_rows(copy_rows, mask, wp.zeros((self.nworld, 1), dtype=float, device=self.device), states[:, :1])
            mjw.set_state(self.m, self.d, states, _SPEC)
        launch_rows(copy_rows, mask, flat(self.d.overflow), flat(bits))
        wp.copy(self.d.overflow, bits)
        self.refresh_current(mask)

    def find_faults(self, mask: wp.array) -> None:
        d = self.d
        bits = [sizes.CONTACT_BITS, sizes.CONSTRAINT_BITS, sizes.IGNORED_BITS]
        args = [mask, d.qpos, d.qvel, d.act, d.overflow, *bits, d.efc.J, self.fault]
        wp.launch(faults.faults_of_fields, self.nworld, args, device=self.device)

    def start_at(self, initial: np.ndarray) -> None:
        super().start_at(initial)
        if self._start is not None:
            self._start.assign(initial.astype(np.float32))

    def reset(self, mask: wp.array) -> None:
        with self._on_device():
            mjw.reset_data(self.m, self.d, reset=mask)
            if self._start is not None:
                launch_rows(copy_rows, mask, repeated(self._start, self.nworld), self._state)
                mjw.set_state(self.m, self.d, self._state, _SPEC, mask)

    def commit(self, mask: wp.array, names: Collection[str] | None = None) -> None:
        """Do nothing, because the fields are the engine's own arrays."""

    def run_for(self, mask: wp.array, run: Callable[[], None]) -> None:
        if self.partial_refresh:
            self._conditional(mask, run)
        else:
            run()

    def refresh(self, mask: wp.array) -> None:
        if self._partial is not None and self.partial_refresh:
            self._partial(mask, self._forward_group, {name: self.arrays[name] for name in self._reset})
        else:
            self.run_for(mask, lambda: self._refresh(mask))

    def _forward_group(self, model: mjw.Model, group: mjw.Data) -> None:
        self._forward(None, self.reset_stage, group, model)
        self._forward(self._shared, self.reset_stage)

    def _refresh(self, mask: wp.array) -> None:
        with self._histories_kept():
            self._forward(self._reset_parts, self.reset_stage)
        self._copy_snapshots(mask, [field for field in self.snapshots if field.reset > Stage.NONE])
        if self._reset_parts is None:
            sizes.report_pool_overflow(self.d, mask)

    def _is_partial(self) -> bool:
        """Whether a group of worlds can be stepped separately."""
        # sweep-and-prune, the broadphase of large models, cannot allocate memory within a graph
        return self.partial_refresh and self.m.opt.broadphase == mjw.BroadphaseType.NXN

    def _group_of_worlds(self) -> PartialForward:
        size = group_size(self.nworld, self.device)
        fields = list(self.dynamics.values())
        names = [field.name for field in fields if field.size and field.in_model] + varied_model.outputs_of(fields)
        with wp.ScopedDevice(self.device):
            rows = varied_model.ModelRows(self.m, names, size)
        return PartialForward(rows, self.d, self._make_data(size), self._state, self._static)

    @contextlib.contextmanager
    def _histories_kept(self) -> Iterator[None]:
        """Return a context that restores the sensor histories when it ends.

        Forward passes in the context add samples to the histories. The next step would add the same samples again.
        """
        if self.d.history.size:
            wp.copy(self._history, self.d.history)
        yield
        if self.d.history.size:
            wp.copy(self.d.history, self._history)

    # state

    def _get_integration(self, state_out: wp.array, mask: wp.array) -> None:
        with self._on_device():
            mjw.get_state(self.m, self.d, self._state, _SPEC)
        launch_rows(widen, mask, self._state, state_out)

    def _set_integration(self, state_in: wp.array, mask: wp.array) -> None:
        launch_rows(narrow, mask, state_in, self._state)
        with self._on_device():
            mjw.set_state(self.m, self.d, self._state, _SPEC, mask)


@contextlib.contextmanager
def refusals(fix: str = "use engine='mujoco'") -> Iterator[None]:
    """Explain an error of MuJoCo Warp about a model."""
    try:
        yield
    except (NotImplementedError, ValueError) as error:
        reason = str(error).rstrip(".")
        raise ValueError(f"MuJoCo Warp refuses the model: {reason}; change the model, or {fix}") from error


def _sizes(
    model: mujoco.MjModel, nconmax: int | None, njmax: int | None, varied: Collection[ModelField]
) -> tuple[int, int]:
    with refusals():
        if (model.geom_plugin >= 0).any() and not has_sdf_functions():
            raise NotImplementedError("SDF plugins need a registered distance function")
        contacts, constraints = probe_sizes(model, varied) if None in (nconmax, njmax) else (0, 0)
    return contacts if nconmax is None else nconmax, constraints if njmax is None else njmax


def _contacts_of_one_world(model: mjw.Model) -> int:
    """Estimate the contacts of a world in which all bodies touch, as can happen just before a reset."""
    pairs = len(model.nxn_geom_pair_filtered)
    return int(min(max(256, 4 * pairs), 4096))
