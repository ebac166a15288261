"""The Warp engine: MuJoCo Warp, float32, on a CUDA device or on the CPU."""

import contextlib
import dataclasses
from collections.abc import Callable, Collection, Iterator
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

from lyceum_warp.arrays import flat, launch_rows
from lyceum_warp.engines.base import Engine
from lyceum_warp.engines.deterministic.contact_order import CanonicalOrder
from lyceum_warp.engines.memory import Footprint, Scratch, bytes_of, check_fit, temporaries
from lyceum_warp.engines.warp.partial import PartialForward, group_size, report_overflow
from lyceum_warp.engines.warp.sizes import probe_sizes
from lyceum_warp.fields import Field, Stage
from lyceum_warp.kernels import faults
from lyceum_warp.kernels.state import copy_rows, narrow, widen

_SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value

_PARTS = (
    (mjw.kinematics, "xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat".split()),
    (mjw.com_pos, "subtree_com cdof cinert".split()),
    (mjw.com_vel, "cvel cdof_dot".split()),
)
"""The cheap parts of a forward pass in their order, and what each computes; each needs those before it."""

_OVERFLOW = mjw.OverflowType
_CONTACT_BITS = int(_OVERFLOW.BROADPHASE | _OVERFLOW.NARROWPHASE)
_CONSTRAINT_BITS = int(_OVERFLOW.NEFC | _OVERFLOW.NJMAX_NNZ | _OVERFLOW.NVMAX)
# a solver that ran into its iteration limit has still given an answer
_IGNORED_BITS = int(_OVERFLOW.ITERATIONS | _OVERFLOW.LS_ITERATIONS)

_MOST_UNROLLED = 20
"""Iterations of the solver that fit a recording; more would take minutes to record and gain nothing."""

_FEW = 256
"""Worlds that fit anywhere, so that nobody has to ask."""

_PROBED = 1024, 2048
"""Numbers of worlds that tell what any number takes: enough of them that Warp makes no buffer larger than it has to."""

_LARGEST_BUFFER = 2**31 - 1
"""Bytes of an array that Warp makes for bytes: an axis may be no longer."""


class WarpEngine(Engine):
    """Worlds in ``mujoco_warp``'s own arrays, shown without a copy.

    Args:
        model: The compiled model.
        nworld: Number of worlds.
        device: A CUDA device, or the CPU (single-threaded: for tests).
        nconmax: Contacts a world has room for on average; None probes the model, and adds to all worlds' room
            together what a single one in an absurd state may need.
        njmax: Constraints a world has room for; None probes the model.
        deterministic: Whether the same worlds take the same steps to the bit on a CUDA device, too, as they always do
            on the CPU.
        unroll: Whether the solver's iterations are all in a recording, instead of a loop that ends with the last
            world's; those that a world does not need leave it as it is.

    Raises:
        ValueError: MuJoCo Warp refuses the model, or so many worlds do not fit into memory.
    """

    name = "warp"
    recordable = True

    partial_refresh = True
    """Whether worlds that begin again get a forward pass of their own, where cheap parts of it are not enough."""

    def __init__(
        self,
        model: mujoco.MjModel,
        nworld: int,
        device: wp.Device,
        *,
        nconmax: int | None = None,
        njmax: int | None = None,
        deterministic: bool = False,
        unroll: bool = False,
    ) -> None:
        spare = nconmax is None
        if nconmax is None or njmax is None:
            contacts, constraints = probe_sizes(model)
            nconmax, njmax = nconmax or contacts, njmax or constraints
        self.model, self.device, self.nconmax, self.njmax = model, device, nconmax, njmax
        self.deterministic, self.unroll = deterministic, unroll
        if unroll and model.opt.iterations > _MOST_UNROLLED:
            raise ValueError(
                f"unroll=True repeats all of the solver's {model.opt.iterations} iterations in every substep: give it "
                "fewer, as with solver={'iterations': 4, 'ls_iterations': 6}"
            )
        if unroll and model.nflex:
            raise ValueError("unroll=True would unroll the collisions of the model's flexes, too: leave it out")
        self._scratch = Scratch(device) if deterministic and device.is_cuda else None
        try:
            self.m = self._put_model()
            self.spare = _one_world(self.m) if spare else 0
            if nworld >= _FEW:
                check_fit(self._arrays_footprint(), nworld, device)
            self.naconmax = nworld * nconmax + self.spare
            self.d = self._make_data(nworld)
        except (NotImplementedError, ValueError) as error:
            if "do not fit" in str(error):
                more = "; deterministic=True takes several times as much" if self._scratch is not None else ""
                raise ValueError(f"{error}{more}") from None
            raise ValueError(
                f"MuJoCo Warp refuses the model: {error}; change the model, or use engine='mujoco'"
            ) from error
        super().__init__(model, nworld, device)
        with wp.ScopedDevice(device):
            self._order = self._in_order(self.m, self.d, self._scratch)
            self._state = wp.zeros((nworld, self.integration_size), dtype=float)
        self._own: dict[str, wp.array] = {}
        # sorting pairs of geoms, as for large models, takes memory that can't be set aside
        self._sorts = self.m.opt.broadphase != mjw.BroadphaseType.NXN
        self._partial: PartialForward | None = None
        self.ctrl = self.d.ctrl

    def _put_model(self) -> mjw.Model:
        with wp.ScopedDevice(self.device):
            model = mjw.put_model(self.model)
        # overflows are reported per world; printed from a kernel they would fill the disk
        model.opt.warn_overflow = 0
        if self.deterministic and self.device.is_cuda:
            model.opt.deterministic = mjw.DeterminismType.ALL
        model.opt.graph_conditional = not self.unroll
        return model

    def _make_data(self, nworld: int, device: str | wp.Device | None = None) -> mjw.Data:
        with wp.ScopedDevice(device or self.device):
            naconmax = nworld * self.nconmax + self.spare
            return mjw.make_data(self.model, nworld=nworld, naconmax=naconmax, njmax=self.njmax)

    def _in_order(self, model: mjw.Model, data: mjw.Data, scratch: Scratch | None = None) -> CanonicalOrder | None:
        if not (self.deterministic and self.device.is_cuda):
            return None
        between: Callable[[], None] = (lambda: None) if scratch is None else scratch.open
        return CanonicalOrder(model, data, between)

    def bare(self) -> tuple[mjw.Model, mjw.Data]:
        """Another model and data of MuJoCo Warp with the same options and sizes, to measure it alone.

        In deterministic mode their recordings take about a hundred times the memory, as nothing is shared.
        """
        model, data = self._put_model(), self._make_data(self.nworld)
        with wp.ScopedDevice(self.device):
            self._in_order(model, data)  # lives on in the model's callbacks
        return model, data

    @property
    def shared_bytes(self) -> int:
        return bytes_of(self.m)

    def footprint(self) -> Footprint:
        """The engine's memory, that of its recordings included; this compiles their kernels in deterministic mode."""
        return self._arrays_footprint() + self._recordings_footprint()

    def prepare(self) -> None:
        if self._scratch is None or self.nworld < _FEW:
            return
        recordings = self._recordings_footprint()
        if self.nworld > recordings.most:
            raise ValueError(
                f"{self.nworld} worlds do not fit into the buffers in which Warp sorts with deterministic=True, of "
                f"{_LARGEST_BUFFER / 1e9:.3g} GB at most: use nworld={recordings.most} at most, or do without it"
            )
        check_fit(self._arrays_footprint() + recordings, self.nworld, self.device, held=bytes_of(self))
        self._scratch.set_aside(recordings.fixed + self.nworld * recordings.each)

    def _arrays_footprint(self) -> Footprint:
        """Memory of the arrays, from those that one world and two worlds have on the CPU."""
        sizes = []
        model = self.m if self._scratch is None else self._put_model()  # one whose callbacks nobody else needs
        for nworld in (1, 2):
            data = self._make_data(nworld, "cpu")
            with wp.ScopedDevice("cpu"):
                order = self._in_order(model, data)
            with wp.ScopedDevice(self.device):
                within = temporaries(lambda data=data: mjw.step(model, data))  # type: ignore[misc]
            sizes.append(bytes_of(data, order) + within)
        return Footprint.of(1, 2, sizes) + Footprint(bytes_of(self.m), 0)

    def _recordings_footprint(self) -> Footprint:
        """Memory that Warp's deterministic launches keep in recordings, from those of a few worlds."""
        if self._scratch is None:
            return Footprint(0, 0)
        sizes, largest = [], []
        for nworld in _PROBED:
            model, data, scratch = self._put_model(), self._make_data(nworld), Scratch(self.device)
            with wp.ScopedDevice(self.device), scratch.serving():
                self._in_order(model, data, scratch)
                mjw.step(model, data)
                with wp.ScopedCapture(self.device):
                    mjw.step(model, data)
            sizes.append(scratch.peak)
            largest.append(scratch.largest)
        buffer = Footprint.of(*_PROBED, largest)
        most = (_LARGEST_BUFFER - buffer.fixed) // max(1, buffer.each)
        return dataclasses.replace(Footprint.of(*_PROBED, sizes), most=most)

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

    @contextlib.contextmanager
    def _launching(self) -> Iterator[None]:
        """For calls of MuJoCo Warp: on the engine's device, with memory for what deterministic launches need."""
        with wp.ScopedDevice(self.device), self._scratch.serving() if self._scratch else contextlib.nullcontext():
            yield

    def step(self, nstep: int) -> None:
        with self._launching():
            for _ in range(nstep):
                mjw.step(self.m, self.d)
            self._copy_snapshots(self._everyone, lagged=True)
            self._refresh_current()
            self._copy_snapshots(self._everyone, lagged=False)

    def _forward(self, names: Collection[str], stage: Stage, data: mjw.Data | None = None) -> None:
        """Run the part of a forward pass that the named fields need; it covers every world of a data."""
        m, d = self.m, self.d if data is None else data
        with self._launching():
            if (parts := _parts(names)) is not None:
                for part in parts:
                    part(m, d)
            elif stage == Stage.ACCELERATION:
                mjw.forward(m, d)
            else:
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
        with self._launching():
            mjw.reset_data(self.m, self.d, reset=mask)

    def commit(self, mask: wp.array) -> None:
        """Nothing to do: the fields are the engine's own arrays."""

    def refresh(self, mask: wp.array) -> None:
        names = [field.name for field in self.fields.values() if field.reset > Stage.NONE]
        stage = self.reset_stage
        cheap = _parts(names) is not None
        if cheap or not self.partial_refresh or self._order is not None or self._sorts:
            self._forward(names, stage)
            self._copy_snapshots(mask)
            if not cheap:
                report_overflow(self.d, mask)
            return
        if self._partial is None:
            group = self._make_data(group_size(self.nworld, self.device))
            self._partial = PartialForward(self.d, group)
        targets = {name: self.arrays[name] for name in names}
        self._partial(mask, lambda data: self._forward(names, stage, data), targets)

    # state

    def _get_integration(self, state_out: wp.array, mask: wp.array) -> None:
        with self._launching():
            mjw.get_state(self.m, self.d, self._state, _SPEC)
        launch_rows(widen, mask, self._state, state_out)

    def _set_integration(self, state_in: wp.array, mask: wp.array) -> None:
        launch_rows(narrow, mask, state_in, self._state)
        with self._launching():
            mjw.set_state(self.m, self.d, self._state, _SPEC, mask)


def _parts(names: Collection[str]) -> list[Callable[[mjw.Model, mjw.Data], None]] | None:
    """The parts of a forward pass that compute the named fields, or None if it takes collisions and constraints."""
    last = -1
    for name in names:
        place = next((i for i, (_, fields) in enumerate(_PARTS) if name in fields), None)
        if place is None:
            return None
        last = max(last, place)
    return [part for part, _ in _PARTS[: last + 1]]


def _one_world(model: mjw.Model) -> int:
    """Contacts to spare for a world in which everything touches everything, which is about to be reset."""
    pairs = len(model.nxn_geom_pair_filtered)
    return int(min(max(256, 4 * pairs), 4096))
