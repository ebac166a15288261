"""A forward pass for a few worlds of many."""

import contextlib
from collections.abc import Callable, Mapping

import mujoco_warp as mjw
import warp as wp

from lyceum_warp.arrays import flat
from lyceum_warp.engines.memory import Arena
from lyceum_warp.fields import STATE_FIELDS
from lyceum_warp.kernels import faults, state


def group_size(nworld: int, device: wp.Device) -> int:
    """Worlds of a group: more than usually begin again in one step, few enough to cost little."""
    return min(nworld, max(1 if device.is_cpu else 64, nworld // 16))


def report_overflow(data: mjw.Data, mask: wp.array) -> None:
    """Set the overflow bits of the masked worlds where a forward pass had too little room for contacts."""
    pool = [data.ncollision, data.nacon, data.naconmax, int(mjw.OverflowType.NARROWPHASE)]
    wp.launch(faults.pool_overflow, data.nworld, [mask, *pool, data.overflow], device=mask.device)


class PartialForward:
    """Computes fields of the masked worlds in a group of other worlds, and brings them back.

    Few worlds begin again in a step, none in most steps of a small batch, and a whole forward pass of all costs as
    much as a substep. So the masked worlds' states go to a small group, in as many turns as it takes.

    Args:
        data: MuJoCo Warp's data of all worlds.
        group: The same of the group.
    """

    def __init__(self, data: mjw.Data, group: mjw.Data) -> None:
        self._data, self._group = data, group
        self._device = wp.get_device(data.qpos.device)
        with wp.ScopedDevice(self._device):
            self._everyone = wp.full(group.nworld, True, dtype=bool)
            self._rank, self._world = wp.zeros(data.nworld, dtype=int), wp.zeros(group.nworld, dtype=int)
            self._count, self._first, self._left = (wp.zeros(1, dtype=int) for _ in range(3))
        self._arena = None if self._device.is_cpu else Arena(self._device)

    def __call__(self, mask: wp.array, forward: Callable[[mjw.Data], None], targets: Mapping[str, wp.array]) -> None:
        """Compute fields of the masked worlds; made of launches.

        Args:
            mask: Which worlds, (nworld,) bool.
            forward: Computes the fields of a data.
            targets: Where the fields go, (nworld, ...), by their names in MuJoCo Warp's data.
        """

        def turn() -> None:
            self._turn(mask, forward, targets)

        with wp.ScopedDevice(self._device):
            self._count.zero_()
            self._first.zero_()
            wp.launch(state.rank_worlds, self._data.nworld, [mask, self._rank, self._count])
            wp.launch(state.next_group, 1, [self._count, 0, self._first, self._left])
            with self._set_aside():
                wp.capture_while(self._left, while_body=turn)

    def _turn(self, mask: wp.array, forward: Callable[[mjw.Data], None], targets: Mapping[str, wp.array]) -> None:
        if self._arena is not None:
            self._arena.open()
        data, group = self._data, self._group
        worlds = [self._world, self._left]
        wp.launch(state.choose_group, data.nworld, [mask, self._rank, self._first, self._world])
        for name in STATE_FIELDS:
            if (source := getattr(data, name)).size:
                rows = flat(getattr(group, name))
                wp.launch(state.take_rows, rows.shape, [*worlds, flat(source), rows])
        group.overflow.zero_()
        forward(group)
        report_overflow(group, self._everyone)
        for name, target in targets.items():
            rows = flat(getattr(group, name))
            wp.launch(state.return_rows, rows.shape, [*worlds, rows, flat(target)])
        wp.launch(state.return_bits, group.nworld, [*worlds, group.overflow, data.overflow])
        wp.launch(state.next_group, 1, [self._count, group.nworld, self._first, self._left])

    def _set_aside(self) -> contextlib.AbstractContextManager[object]:
        """Memory for what a turn allocates: within a loop of a CUDA graph nothing may be."""
        if self._arena is None:
            return contextlib.nullcontext()
        return self._arena.serving() if self._device.is_capturing else self._arena.counting()
