"""Allocate the buffers in which Warp's deterministic launches sort their atomic additions."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator

import warp as wp

from lyceum_warp.engines.warp.group import Reserve, aligned

LARGEST_BUFFER = 2**31 - 1
"""Bytes of the largest array of bytes that Warp can make: an axis has fewer than 2**31 elements."""

_PROBED = 1024, 2048
"""Numbers of worlds to extrapolate from: large enough that no buffer of Warp has its minimum size."""


class Scratch(Reserve):
    """An allocator that gives the buffers of all launches the same memory.

    In Warp a graph keeps separate buffers for each of its launches, which take about a hundred times the memory of the
    worlds. But launches run one after another and clear their buffers first, so they can share them. Warp also clears
    them during a capture: no graph may run then.

    Args:
        device: A CUDA device.
    """

    def __init__(self, device: wp.Device) -> None:
        super().__init__(device)
        self._block, self._used, self._now = 0, 0, 0
        self.peak = 0
        """The most bytes that were allocated between two calls of ``open``."""
        self.largest = 0
        """The most bytes of one allocation."""

    def open(self) -> None:
        """Reuse the memory from its start, for the launches that follow."""
        self._block, self._used, self._now = 0, 0, 0

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Serve launches within the context from the reserve while they are captured."""
        self.open()
        with wp.ScopedAllocator(self.device, self):
            yield

    def allocate(self, size_in_bytes: int) -> int:
        """Allocate memory, from a new block once the reserve is used up, and return its address."""
        # Warp allocates these buffers on a separate stream, outside the capture; all other memory belongs to the graph
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
    """Bytes of scratch that worlds need, and the largest number of worlds."""

    fixed: int
    """Bytes beside those for each world."""
    each: int
    """Bytes for each world."""
    most: int
    """The largest number of worlds whose buffers Warp can make."""

    @classmethod
    def probe(cls, capture: Callable[[int], Scratch]) -> "ScratchSizes":
        """Extrapolate from the scratch memory of two numbers of worlds.

        Args:
            capture: Captures a step of a number of worlds and returns the scratch memory that it used.
        """
        few, more = (capture(nworld) for nworld in _PROBED)
        fixed, each = _line(few.peak, more.peak)
        fixed_buffer, each_buffer = _line(few.largest, more.largest)
        return cls(fixed, each, (LARGEST_BUFFER - fixed_buffer) // max(1, each_buffer))

    def bytes_of(self, nworld: int) -> int:
        """Bytes for a number of worlds."""
        return self.fixed + nworld * self.each


def _line(few: int, more: int) -> tuple[int, int]:
    """The fixed bytes and the bytes for each world, from the bytes of the two numbers of worlds."""
    each = -(-(more - few) // (_PROBED[1] - _PROBED[0]))
    return max(0, few - _PROBED[0] * each), each
