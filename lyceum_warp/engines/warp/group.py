"""Move masked worlds through a small group of worlds, in turns, with memory that graphs may use."""

import contextlib
from collections.abc import Callable, Iterator

import warp as wp

from lyceum_warp.engines.warp import warp_kernels as kernels
from lyceum_warp.support.arrays import flat

_ALIGNED = 512


class Reserve:
    """Blocks of memory on a device, with that part of Warp's protocol for allocators which frees memory.

    Blocks stay allocated as long as the reserve, because graphs hold their addresses.

    Args:
        device: The device.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.below = device.get_allocator()
        """The device's allocator, for the blocks and for all memory that is not reserved."""
        self.blocks: list[wp.array] = []

    def add_block(self, size: int) -> None:
        """Allocate a block of at least so many bytes."""
        rows = aligned(max(size, 1)) // _ALIGNED  # an axis may be no longer than 2**31
        with wp.ScopedAllocator(self.device, self.below):
            self.blocks.append(wp.empty((rows, _ALIGNED), dtype=wp.uint8, device=self.device))

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Free an address, unless it lies in a block."""
        if not any(block.ptr <= ptr < block.ptr + block.size for block in self.blocks):
            self.below.deallocate(ptr, size_in_bytes)


def aligned(size: int) -> int:
    """A number of bytes, rounded up to a multiple of the alignment of addresses."""
    return -(-size // _ALIGNED) * _ALIGNED


def group_size(nworld: int, device: wp.Device) -> int:
    """Worlds of a group: more than usually restart in one step, and few enough for a cheap forward pass."""
    return min(nworld, max(1 if device.is_cpu else 64, nworld // 16))


class Turns:
    """Takes the masked worlds into a group and back, a group at a time; made of launches.

    No turn is taken where no world is masked.

    Args:
        nworld: Number of worlds.
        size: Places in the group.
        device: Where they live.
        loop: Whether turns are taken in a loop; if not, the group has a place for every world, and one turn is taken
            whatever the mask. Deterministic launches need this: within a loop of a CUDA graph they find no memory.
    """

    def __init__(self, nworld: int, size: int, device: wp.Device, *, loop: bool = True) -> None:
        self.nworld, self.size, self.device, self._loop = nworld, size, device, loop
        with wp.ScopedDevice(device):
            self._rank, self._world = wp.zeros(nworld, dtype=int), wp.zeros(size, dtype=int)
            self._count, self._first, self._left = (wp.zeros(1, dtype=int) for _ in range(3))
        self._memory = TemporaryMemory(device)

    def run(self, mask: wp.array, turn: Callable[[], None]) -> None:
        """Call ``turn`` for one group after another; it may use ``take`` and ``give``."""
        with wp.ScopedDevice(self.device):
            self._count.zero_()
            self._first.zero_()
            wp.launch(kernels.rank_worlds, self.nworld, [mask, self._rank, self._count])
            wp.launch(kernels.next_group, 1, [self._count, 0, self._first, self._left])

            def body() -> None:
                self._memory.open()
                wp.launch(kernels.choose_group, self.nworld, [mask, self._rank, self._first, self._world])
                turn()
                wp.launch(kernels.next_group, 1, [self._count, self.size, self._first, self._left])

            if not self._loop:
                body()
                return
            with self._memory():
                wp.capture_while(self._left, while_body=body)

    def take(self, source: wp.array, target: wp.array) -> None:
        """Copy the rows of the group's worlds, (nworld, ...), into the group, (size, ...)."""
        rows = flat(target)
        if rows.size:
            wp.launch(kernels.take_rows, rows.shape, [self._world, self._left, flat(source), rows])

    def give(self, source: wp.array, target: wp.array) -> None:
        """Copy the group's rows, (size, ...), back into those of its worlds, (nworld, ...)."""
        rows = flat(source)
        if rows.size:
            wp.launch(kernels.return_rows, rows.shape, [self._world, self._left, rows, flat(target)])

    def give_bits(self, source: wp.array, target: wp.array) -> None:
        """Add the group's bits, (size,), to those of its worlds, (nworld,)."""
        wp.launch(kernels.return_bits, self.size, [self._world, self._left, source, target])


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


class TemporaryMemory:
    """Memory for temporary arrays within a loop or a branch of a CUDA graph, which may allocate nothing.

    Args:
        device: Where the launches run; on the CPU nothing is reserved.
    """

    def __init__(self, device: wp.Device) -> None:
        self._device, self._arena = device, None if device.is_cpu else Arena(device)

    def open(self) -> None:
        """Reuse the reserve from its start."""
        if self._arena is not None:
            self._arena.open()

    def __call__(self) -> contextlib.AbstractContextManager[object]:
        """The context of the launches: it counts what they allocate, or, during a capture, serves the reserve."""
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
        self._memory = TemporaryMemory(device)
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
