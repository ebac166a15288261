"""Process masked worlds one group at a time, and reserve memory for launches within graphs."""

import contextlib
from collections.abc import Callable, Iterator

import warp as wp

from lyceum_warp.engines.warp import warp_kernels as kernels
from lyceum_warp.graphs.capture import Graphs, Phase
from lyceum_warp.support.arrays import flat

_ALIGNED = 512


class Reserve:
    """Holds blocks of memory to which graphs refer by address; the blocks live as long as this object.

    Subclasses implement ``allocate`` and can then serve as Warp allocators.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.below = device.get_allocator()
        """The device's allocator."""
        self.blocks: list[wp.array] = []

    def add_block(self, size: int) -> None:
        """Allocate a block of at least ``size`` bytes."""
        rows = aligned(max(size, 1)) // _ALIGNED  # two axes, because an axis has fewer than 2**31 elements
        with wp.ScopedAllocator(self.device, self.below):
            self.blocks.append(wp.empty((rows, _ALIGNED), dtype=wp.uint8, device=self.device))

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Free an address, unless it is inside a block."""
        if not any(block.ptr <= ptr < block.ptr + block.size for block in self.blocks):
            self.below.deallocate(ptr, size_in_bytes)


def aligned(size: int) -> int:
    """Round a number of bytes up to a multiple of the alignment."""
    return -(-size // _ALIGNED) * _ALIGNED


def group_size(nworld: int, device: wp.Device) -> int:
    """Return the number of worlds in a group.

    A group has room for the usual number of restarts in a step. It is small enough for a cheap forward pass.
    """
    return min(nworld, max(1 if device.is_cpu else 64, nworld // 16))


class Turns:
    """Copies the masked worlds into a group and back, one group at a time, by Warp launches only.

    If ``loop`` is False, the group must have room for every world. Deterministic launches require this, because they
    cannot allocate within a graph's loop.
    """

    def __init__(self, nworld: int, size: int, device: wp.Device, *, loop: bool = True) -> None:
        self.nworld, self.size = nworld, size
        self.device, self._loop = device, loop
        with wp.ScopedDevice(device):
            self._rank, self._world = wp.zeros(nworld, dtype=int), wp.zeros(size, dtype=int)
            self._count = wp.zeros(1, dtype=int)
            self._first = wp.zeros(1, dtype=int)
            self._left = wp.zeros(1, dtype=int)
        self._memory = Arena(device)

    def run(self, mask: wp.array, turn: Callable[[], None]) -> None:
        """Call ``turn`` once for each group of masked worlds.

        ``turn`` can call ``take`` and ``give`` to copy the rows of the current group.
        """
        with wp.ScopedDevice(self.device):
            self._count.zero_()
            self._first.zero_()
            wp.launch(kernels.rank_worlds, self.nworld, [mask, self._rank, self._count])
            wp.launch(kernels.next_group, 1, [self._count, 0, self._first, self._left])

            def group() -> None:
                wp.launch(kernels.choose_group, self.nworld, [mask, self._rank, self._first, self._world])
                turn()
                wp.launch(kernels.next_group, 1, [self._count, self.size, self._first, self._left])

            if not self._loop:  # graphs can allocate, also the buffers of deterministic launches
                group()
                return

            def body() -> None:
                with self._memory():
                    self._memory.open()
                    group()

            # outside a graph, the host repeats the turns: from the second on, it replays one that it has captured
            calls = Graphs(self.device, enabled=not self.device.is_capturing).sequence([Phase("turn", body)])
            wp.capture_while(self._left, while_body=calls[0])

    def take(self, source: wp.array, target: wp.array) -> None:
        """Copy the group's rows from an array of all worlds (nworld, ...) to an array of the group (size, ...)."""
        rows = flat(target)
        if rows.size:
            wp.launch(kernels.take_rows, rows.shape, [self._world, self._left, flat(source), rows])

    def give(self, source: wp.array, target: wp.array) -> None:
        """Copy the group's rows (size, ...) back into the rows of all worlds (nworld, ...)."""
        rows = flat(source)
        if rows.size:
            wp.launch(kernels.return_rows, rows.shape, [self._world, self._left, rows, flat(target)])

    def give_bits(self, source: wp.array, target: wp.array) -> None:
        """Copy the set bits of each row of the group to the row's world. Other bits of the world do not change."""
        wp.launch(kernels.return_bits, self.size, [self._world, self._left, source, target])


class Arena(Reserve):
    """An allocator for loops and branches of CUDA graphs, where Warp cannot allocate.

    A run outside a graph determines how many bytes to reserve. Graphs share this memory, because they never run at the
    same time.
    """

    def __init__(self, device: wp.Device) -> None:
        super().__init__(device)
        self._size, self._used = 0, 0
        self._serving = False

    def open(self) -> None:
        """Mark the reserved memory as free, so that the following launches reuse it."""
        self._used = 0

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        """Return a context for launches; captures use the reserved memory."""
        if self.device.is_cpu:
            yield
            return
        self._serving = self.device.is_capturing
        try:
            with wp.ScopedAllocator(self.device, self):
                yield
        finally:
            self._serving = False
        if not self.device.is_capturing and (not self.blocks or self.blocks[-1].size < self._size):
            self.add_block(self._size)

    def allocate(self, size_in_bytes: int) -> int:
        """Allocate memory, and return its address."""
        start = self._used
        self._used += aligned(size_in_bytes)
        if not self._serving:
            self._size = max(self._size, self._used)
            return int(self.below.allocate(size_in_bytes))
        if not self.blocks or self._used > self.blocks[-1].size:
            raise RuntimeError(
                "a graph needs more memory than is reserved: call the captured function once before the capture"
            )
        return int(self.blocks[-1].ptr) + start


class Conditional:
    """Skips launches within a graph if a mask is empty.

    Outside a graph, the launches always run, because reading the mask would wait for the device.
    """

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        self._any = wp.zeros(1, dtype=int, device=device)
        self._memory = Arena(device)
        self._inside = False

    def __call__(self, mask: wp.array, run: Callable[[], None]) -> None:
        """Run launches that affect only the masked worlds.

        ``mask`` is (nworld,) bool. If ``run`` calls this method again, the inner call ignores the argument ``mask``.
        """
        if self._inside:
            run()
            return
        self._inside = True
        try:
            with wp.ScopedDevice(self._device):
                self._memory.open()
                if not self._device.is_capturing:
                    with self._memory():
                        run()
                    return
                self._any.zero_()
                wp.launch(kernels.find_any, len(mask), [mask, self._any])
                with self._memory():
                    wp.capture_if(self._any, on_true=run)
        finally:
            self._inside = False
