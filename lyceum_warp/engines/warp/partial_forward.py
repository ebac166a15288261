"""A forward pass for a few worlds of many."""

import contextlib
from collections.abc import Callable, Iterator, Mapping

import mujoco
import mujoco_warp as mjw
import warp as wp

from lyceum_warp.arrays import flat
from lyceum_warp.engines.warp import partial_kernels as kernels
from lyceum_warp.engines.warp.memory_reserve import Reserve, aligned
from lyceum_warp.engines.warp.overflow import report_pool_overflow

_SPEC = mujoco.mjtState.mjSTATE_INTEGRATION.value


def group_size(nworld: int, device: wp.Device) -> int:
    """Worlds of a group: more than usually restart in one step, and few enough for a cheap forward pass."""
    return min(nworld, max(1 if device.is_cpu else 64, nworld // 16))


class PartialForward:
    """Computes fields of the masked worlds in a group of other worlds, and copies them back.

    Few worlds restart in a step, none in most steps of a small batch, and a forward pass of all worlds costs as much
    as a substep. So the masked worlds' states are copied into a small group, in as many turns as it takes.

    Args:
        model: MuJoCo Warp's model.
        data: MuJoCo Warp's data of all worlds.
        group: The same of the group.
        states: Room for the integration states of all worlds, (nworld, integration size), float32.
    """

    def __init__(self, model: mjw.Model, data: mjw.Data, group: mjw.Data, states: wp.array) -> None:
        self._model, self._data, self._group, self._states = model, data, group, states
        self._device = wp.get_device(data.qpos.device)
        with wp.ScopedDevice(self._device):
            self._group_states = wp.zeros((group.nworld, states.shape[1]), dtype=float)
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
            mjw.get_state(self._model, self._data, self._states, _SPEC, mask)
            wp.launch(kernels.rank_worlds, self._data.nworld, [mask, self._rank, self._count])
            wp.launch(kernels.next_group, 1, [self._count, 0, self._first, self._left])
            with self._reserved():
                wp.capture_while(self._left, while_body=turn)

    def _turn(self, mask: wp.array, forward: Callable[[mjw.Data], None], targets: Mapping[str, wp.array]) -> None:
        if self._arena is not None:
            self._arena.open()
        data, group = self._data, self._group
        worlds = [self._world, self._left]
        wp.launch(kernels.choose_group, data.nworld, [mask, self._rank, self._first, self._world])
        wp.launch(kernels.take_rows, self._group_states.shape, [*worlds, self._states, self._group_states])
        mjw.set_state(self._model, group, self._group_states, _SPEC)
        group.overflow.zero_()
        forward(group)
        report_pool_overflow(group, self._everyone)
        results = {name: (getattr(group, name), target) for name, target in targets.items()}
        for source, target in results.values():
            rows = flat(source)
            wp.launch(kernels.return_rows, rows.shape, [*worlds, rows, flat(target)])
        wp.launch(kernels.return_bits, group.nworld, [*worlds, group.overflow, data.overflow])
        wp.launch(kernels.next_group, 1, [self._count, group.nworld, self._first, self._left])

    def _reserved(self) -> contextlib.AbstractContextManager[object]:
        """Memory for the temporary arrays of a turn: within a loop of a CUDA graph nothing may be allocated."""
        if self._arena is None:
            return contextlib.nullcontext()
        return self._arena.serving() if self._device.is_capturing else self._arena.counting()


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

    def __call__(self, mask: wp.array, run: Callable[[], None]) -> None:
        """Run launches for the masked worlds, (nworld,) bool, which may not matter to any other world."""
        if not self._device.is_capturing:
            with contextlib.nullcontext() if self._arena is None else self._arena.counting():
                self._open()
                run()
            return
        with wp.ScopedDevice(self._device):
            self._any.zero_()
            wp.launch(kernels.find_any, len(mask), [mask, self._any])
            self._open()
            with contextlib.nullcontext() if self._arena is None else self._arena.serving():
                wp.capture_if(self._any, on_true=run)

    def _open(self) -> None:
        if self._arena is not None:
            self._arena.open()


class Arena(Reserve):
    """An allocator for graphs, which may not allocate: it counts the bytes of a run outside a graph and reserves them.

    While it counts, memory comes from the device. Graphs are served from the reserve; they never run at the same time,
    so all of them may use the same memory.

    Args:
        device: A CUDA device.
    """

    def __init__(self, device: wp.Device) -> None:
        super().__init__(device)
        self._size, self._used = 0, 0
        self._serving = False

    def open(self) -> None:
        """Reuse the reserve from its start."""
        self._used = 0

    @contextlib.contextmanager
    def counting(self) -> Iterator[None]:
        """Count the bytes that are allocated between one ``open`` and the next, and reserve the most at the end."""
        self._serving = False
        with wp.ScopedAllocator(self.device, self):
            yield
        if not self.blocks or self.blocks[-1].size < self._size:
            self.add_block(self._size)

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Hand out the reserve."""
        self._serving = True
        try:
            with wp.ScopedAllocator(self.device, self):
                yield
        finally:
            self._serving = False

    def allocate(self, size_in_bytes: int) -> int:
        """The address of so many free bytes."""
        start = self._used
        self._used += aligned(size_in_bytes)
        if not self._serving:
            self._size = max(self._size, self._used)
            return int(self.below.allocate(size_in_bytes))
        if not self.blocks or self._used > self.blocks[-1].size:
            raise RuntimeError("a graph needs more memory than is reserved: call the function once before its capture")
        return int(self.blocks[-1].ptr) + start
