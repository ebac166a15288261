"""The Warp engine: MuJoCo Warp, float32, on a CUDA device or on the CPU."""

from collections.abc import Iterable
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

from lyceum_warp.engines.base import Engine
from lyceum_warp.engines.sizes import probe_sizes
from lyceum_warp.fields import Field, Stage
from lyceum_warp.kernels import faults
from lyceum_warp.kernels.arrays import flat
from lyceum_warp.kernels.state import copy_rows, launch_rows, narrow, widen

_SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value

# fields that kinematics and com_pos compute, without collisions and the constraint Jacobian
_KINEMATIC = frozenset(
    "xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat subtree_com cdof cinert".split()
)

_OVERFLOW = mjw.OverflowType
_CONTACT_BITS = int(_OVERFLOW.BROADPHASE | _OVERFLOW.NARROWPHASE)
_CONSTRAINT_BITS = int(_OVERFLOW.NEFC | _OVERFLOW.NJMAX_NNZ | _OVERFLOW.NVMAX)
# a solver that ran into its iteration limit has still given an answer
_IGNORED_BITS = int(_OVERFLOW.ITERATIONS | _OVERFLOW.LS_ITERATIONS)


class WarpEngine(Engine):
    """Worlds in ``mujoco_warp``'s own arrays, shown without a copy.

    Args:
        model: The compiled model.
        nworld: Number of worlds.
        device: A CUDA device, or the CPU (single-threaded: for tests).
        nconmax: Contacts a world has room for on average; None probes the model.
        njmax: Constraints a world has room for; None probes the model.

    Raises:
        ValueError: MuJoCo Warp refuses the model.
    """

    name = "warp"
    recordable = True

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        device: wp.Device,
        *,
        nconmax: int | None = None,
        njmax: int | None = None,
    ) -> None:
        super().__init__(model, nworld, device)
        if nconmax is None or njmax is None:
            contacts, constraints = probe_sizes(model)
            nconmax, njmax = nconmax or contacts, njmax or constraints
        self.nconmax, self.njmax = nconmax, njmax
        self._own: dict[str, wp.array] = {}
        with wp.ScopedDevice(device):
            try:
                self.m = mjw.put_model(model)
                self.d = mjw.make_data(model, nworld=nworld, nconmax=nconmax, njmax=njmax)
            except (NotImplementedError, ValueError) as error:
                raise ValueError(
                    f"MuJoCo Warp refuses the model: {error}; change the model, or use engine='mujoco'"
                ) from error
            # overflows are reported per world; printed from a kernel they would fill the disk
            self.m.opt.warn_overflow = 0
            self._state = wp.zeros((nworld, self.integration_size), dtype=float, device=device)
        self.ctrl = self.d.ctrl

    # fields

    def _bind(self, field: Field) -> wp.array:
        source = getattr(self.d, field.name)
        # the same memory under the types of `fields`, which differ from MuJoCo Warp's in name alone
        own: Any = wp.array(ptr=source.ptr, dtype=field.dtype, shape=(self.nworld, *field.shape), device=self.device)
        own.owner = source  # a view of this memory may outlive the engine
        self._own[field.name] = own
        if field.reset > Stage.NONE:
            self._forward([field.name], field.reset)
        if not field.snapshot:
            return own
        return wp.clone(own)

    def _copy_snapshots(self, mask: wp.array, *, lagged: bool | None = None) -> None:
        for field in self.snapshots:
            if lagged is None or field.lagged == lagged:
                launch_rows(copy_rows, mask, flat(self._own[field.name]), flat(self.arrays[field.name]))

    # physics

    def step(self, nstep: int) -> None:
        with wp.ScopedDevice(self.device):
            for _ in range(nstep):
                mjw.step(self.m, self.d)
            self._copy_snapshots(self._everyone, lagged=True)
            self._refresh_current()
            self._copy_snapshots(self._everyone, lagged=False)

    def _forward(self, names: Iterable[str], stage: Stage) -> None:
        """Run the part of a forward pass that the named fields need; it covers every world."""
        m, d = self.m, self.d
        with wp.ScopedDevice(self.device):
            if stage == Stage.ACCELERATION:
                mjw.forward(m, d)
            elif stage == Stage.POSITION and _KINEMATIC.issuperset(names):
                mjw.kinematics(m, d)
                mjw.com_pos(m, d)
            elif stage > Stage.NONE:
                mjw.fwd_position(m, d)
                mjw.sensor_pos(m, d)
                if stage == Stage.VELOCITY:
                    mjw.fwd_velocity(m, d)
                    mjw.sensor_vel(m, d)

    def _refresh_current(self, mask: wp.array | None = None) -> None:
        self._forward([field.name for field in self.fields.values() if field.refresh > Stage.NONE], self.stage)

    def find_faults(self, mask: wp.array) -> None:
        d = self.d
        bits = [_CONTACT_BITS, _CONSTRAINT_BITS, _IGNORED_BITS]
        args = [mask, d.qpos, d.qvel, d.act, d.overflow, *bits, self.fault]
        wp.launch(faults.faults_of_fields, self.nworld, args, device=self.device)

    def reset(self, mask: wp.array) -> None:
        with wp.ScopedDevice(self.device):
            mjw.reset_data(self.m, self.d, reset=mask)

    def commit(self, mask: wp.array) -> None:
        """Nothing to do: the fields are the engine's own arrays."""

    def refresh(self, mask: wp.array) -> None:
        self._forward([field.name for field in self.fields.values() if field.reset > Stage.NONE], self.reset_stage)
        self._copy_snapshots(mask)

    # state

    def _get_integration(self, state_out: wp.array, mask: wp.array) -> None:
        with wp.ScopedDevice(self.device):
            mjw.get_state(self.m, self.d, self._state, _SPEC)
        launch_rows(widen, mask, self._state, state_out)

    def _set_integration(self, state_in: wp.array, mask: wp.array) -> None:
        launch_rows(narrow, mask, state_in, self._state)
        with wp.ScopedDevice(self.device):
            mjw.set_state(self.m, self.d, self._state, _SPEC, mask)
