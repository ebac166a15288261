"""Allocate the buffers in which Warp's deterministic launches sort their atomic additions."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator

import warp as wp

from lyceum_warp.engines.warp.group import Reserve, aligned

LARGEST_BUFFER = 2**31 - 1
"""Size of the largest byte array in Warp. An axis of a Warp array has fewer than 2**31 elements."""

_PROBED = 1024, 2048
"""Scratch memory is measured with each of these numbers of worlds. With so many worlds, Warp's minimum buffer size does
not affect the result."""


class Scratch(Reserve):
    """An allocator that places the buffers of all launches in the same memory.

    By default, each launch in a graph has its own buffers, which take about a hundred times as much memory as the
    worlds. Launches can share buffers, because they run one after another and clear the buffers first. Warp also clears
    the buffers during a capture, so no graph may run then.
    """

    def __init__(self, device: wp.Device) -> None:
        super().__init__(device)
        self._block, self._used, self._now = 0, 0, 0
        self.peak = 0
        """The largest number of bytes allocated between two calls of ``open``."""
        self.largest = 0

    def open(self) -> None:
        """Mark the shared memory as free, so that the following launches reuse it."""
        self._block, self._used, self._now = 0, 0, 0

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Return a context in which captured launches use this memory."""
        self.open()
        with wp.ScopedAllocator(self.device, self):
            yield

    def allocate(self, size_in_bytes: int) -> int:
        """Allocate shared memory, and return its address."""
        # Warp allocates buffers for sorting on another stream, outside the capture; the graph owns all other memory
        if not self.device.is_capturing or self.device.stream.is_capturing:
            return int(self.below.allocate(size_in_bytes))
        size = aligned(size_in_bytes)
        self._now += size
        self.peak, self.largest = max(self.peak, self._now), max(self.largest, size)
        while self._block < len(self.blocks) and self._used + size > self.blocks[self._block].size:
            self._block, self._used = self._block + 1, 0
        if self._block == len(self.blocks):
            self.add_block(size)
        self._used += size
        return int(self.blocks[self._block].ptr) + self._used - size


@dataclasses.dataclass(frozen=True)
class ScratchSizes:
    """Computes the scratch bytes for a number of worlds, and the largest number of worlds that Warp supports."""

    fixed: int
    each: int
    most: int

    @classmethod
    def probe(cls, capture: Callable[[int], Scratch]) -> "ScratchSizes":
        """Measure the scratch memory of 1024 and of 2048 worlds, and fit a line to the results."""
        few, more = map(capture, _PROBED)
        fixed, each = _line(few.peak, more.peak)
        fixed_buffer, each_buffer = _line(few.largest, more.largest)
        return cls(fixed, each, (LARGEST_BUFFER - fixed_buffer) // max(1, each_buffer))

    def bytes_of(self, nworld: int) -> int:
        """Return the scratch bytes for a number of worlds."""
        return self.fixed + nworld * self.each


def _line(few: int, more: int) -> tuple[int, int]:
    each = -(-(more - few) // (_PROBED[1] - _PROBED[0]))
    return max(0, few - _PROBED[0] * each), each
