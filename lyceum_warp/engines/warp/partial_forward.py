"""A forward pass, or steps, for a few worlds of many."""

import contextlib
from collections.abc import Callable, Mapping

import mujoco
import mujoco_warp as mjw
import warp as wp

from lyceum_warp.arrays import launch_rows
from lyceum_warp.engines.warp import partial_kernels as kernels
from lyceum_warp.engines.warp import substep
from lyceum_warp.engines.warp.group_turns import Arena, Turns
from lyceum_warp.engines.warp.model_rows import ModelRows
from lyceum_warp.engines.warp.overflow import report_pool_overflow
from lyceum_warp.engines.warp.static_geoms import StaticGeoms
from lyceum_warp.kernels.state import copy_rows

_SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value


class PartialForward:
    """Computes fields of the masked worlds in a group of other worlds, and copies them back.

    Few worlds restart in a step, none in most steps of a small batch, and a forward pass of all worlds costs as much
    as a substep. So the masked worlds' states are copied into a small group, in as many turns as it takes.

    Args:
        rows: The group's view of MuJoCo Warp's model.
        data: MuJoCo Warp's data of all worlds.
        group: The same of the group.
        states: Room for the integration states of all worlds, (nworld, integration size), float32.
        static: Geoms whose poses a forward pass does not compute.
    """

    def __init__(self, rows: ModelRows, data: mjw.Data, group: mjw.Data, states: wp.array, static: StaticGeoms) -> None:
        self._rows, self._data, self._group, self._states, self._static = rows, data, group, states, static
        self._device = wp.get_device(data.qpos.device)
        with wp.ScopedDevice(self._device):
            self._group_states = wp.zeros((group.nworld, states.shape[1]), dtype=float)
            self._everyone = wp.full(group.nworld, True, dtype=bool)
            self._no_time = wp.zeros((data.nworld, 1), dtype=float)
        self._turns = Turns(data.nworld, group.nworld, self._device)

    def __call__(
        self, mask: wp.array, forward: Callable[[mjw.Model, mjw.Data], None], targets: Mapping[str, wp.array]
    ) -> None:
        """Compute fields of the masked worlds; made of launches.

        Args:
            mask: Which worlds, (nworld,) bool.
            forward: Computes the fields of a data.
            targets: Where the fields go, (nworld, ...), by their names in MuJoCo Warp's data.
        """
        data, group = self._data, self._group

        def turn() -> None:
            self._enter()
            forward(self._rows.model, group)
            report_pool_overflow(group, self._everyone)
            results = {name: (getattr(group, name), target) for name, target in targets.items()}
            for source, target in results.values():
                self._turns.give(source, target)
            self._turns.give_bits(group.overflow, data.overflow)

        with wp.ScopedDevice(self._device):
            mjw.get_state(self._rows.whole, data, self._states, _SPEC, mask)
            self._turns.run(mask, turn)

    def settle(self, mask: wp.array, nstep: int) -> None:
        """Advance the masked worlds' states by some substeps, and set their time to 0; made of launches."""
        data, group = self._data, self._group

        def turn() -> None:
            self._enter()
            for _ in range(nstep):
                substep.step(self._rows.model, group)
            mjw.get_state(self._rows.model, group, self._group_states, _SPEC)
            self._turns.give(self._group_states, self._states)
            self._turns.give_bits(group.overflow, data.overflow)

        with wp.ScopedDevice(self._device):
            mjw.get_state(self._rows.whole, data, self._states, _SPEC, mask)
            self._turns.run(mask, turn)
            launch_rows(copy_rows, mask, self._no_time, self._states[:, :1])  # time is the first number of a state
            mjw.set_state(self._rows.whole, data, self._states, _SPEC, mask)

    def _enter(self) -> None:
        """Put the group into the models and states of its worlds."""
        self._rows.take(self._turns)
        self._static.place(self._rows.model, self._group, self._everyone)
        self._turns.take(self._states, self._group_states)
        mjw.set_state(self._rows.model, self._group, self._group_states, _SPEC)
        self._group.overflow.zero_()


class Conditional:
    """Runs launches if a mask holds a world, and costs next to nothing in a graph if it holds none.

    Outside a graph it always runs them, without a look at the mask, which may still be in the making.

    Args:
        device: Where the launches run.
    """

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._any = wp.zeros(1, dtype=int, device=device)
        self._arena = None if device.is_cpu else Arena(device)
        self._inside = False

    def __call__(self, mask: wp.array, run: Callable[[], None]) -> None:
        """Run launches for the masked worlds, (nworld,) bool, which may not matter to any other world.

        Within such launches, others run unconditionally.
        """
        if self._inside:
            run()
            return
        self._inside = True
        try:
            with wp.ScopedDevice(self._device):
                if not self._device.is_capturing:
                    with self._reserved(capturing=False):
                        run()
                    return
                self._any.zero_()
                wp.launch(kernels.find_any, len(mask), [mask, self._any])
                with self._reserved(capturing=True):
                    wp.capture_if(self._any, on_true=run)
        finally:
            self._inside = False

    def _reserved(self, *, capturing: bool) -> contextlib.AbstractContextManager[object]:
        """Memory for temporary arrays: within a conditional part of a CUDA graph nothing may be allocated."""
        if self._arena is None:
            return contextlib.nullcontext()
        self._arena.open()
        return self._arena.serving() if capturing else self._arena.counting()
