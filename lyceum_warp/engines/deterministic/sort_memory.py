"""Memory for the buffers in which Warp's deterministic launches sort their atomic additions."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator

import warp as wp

from lyceum_warp.engines.warp.group import Reserve, aligned

LARGEST_BUFFER = 2**31 - 1
"""Bytes of the largest array of bytes that Warp makes: an axis may be no longer."""

_PROBED = 1024, 2048
"""Numbers of worlds from which any other is extrapolated: large enough that Warp makes no buffer of a minimum size."""


class Scratch(Reserve):
    """An allocator for those buffers.

    Warp lets a graph keep the buffers of each of its launches, which takes about a hundred times a world's own memory.
    But launches follow one another, and each begins by clearing its buffers, so all of them may have the same memory.
    Warp clears them during a capture, too: no graph may run then.

    Args:
        device: A CUDA device.
    """

    def __init__(self, device: wp.Device) -> None:
        super().__init__(device)
        self._block, self._used, self._now = 0, 0, 0
        self.peak = 0
        """The most bytes that were handed out between one ``open`` and the next."""
        self.largest = 0
        """The most bytes that were handed out at once."""

    def open(self) -> None:
        """Reuse the memory from its start: earlier launches are over when later ones run."""
        self._block, self._used, self._now = 0, 0, 0

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Hand out the reserve to launches that are being captured; nothing changes for others."""
        self.open()
        with wp.ScopedAllocator(self.device, self):
            yield

    def allocate(self, size_in_bytes: int) -> int:
        """The address of so many free bytes, from a new block once the reserve is used up."""
        # Warp makes these buffers on a stream of their own, outside the capture; everything else belongs to the graph
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
    """How many bytes of scratch a number of worlds needs, and how many worlds there can be."""

    fixed: int
    """Bytes for any number of worlds."""
    each: int
    """Bytes for each world."""
    most: int
    """The number of worlds for which Warp can still make its largest buffer."""

    @classmethod
    def probe(cls, capture: Callable[[int], Scratch]) -> "ScratchSizes":
        """Extrapolate from the scratch that few worlds need.

        Args:
            capture: Captures a step of a number of worlds and returns the scratch that served it.
        """
        few, more = (capture(nworld) for nworld in _PROBED)
        fixed, each = _line(few.peak, more.peak)
        fixed_buffer, each_buffer = _line(few.largest, more.largest)
        return cls(fixed, each, (LARGEST_BUFFER - fixed_buffer) // max(1, each_buffer))

    def bytes_of(self, nworld: int) -> int:
        """Bytes that so many worlds need."""
        return self.fixed + nworld * self.each


def _line(few: int, more: int) -> tuple[int, int]:
    """Bytes in any case and bytes for each world, from the bytes of the two numbers of worlds."""
    each = -(-(more - few) // (_PROBED[1] - _PROBED[0]))
    return max(0, few - _PROBED[0] * each), each
