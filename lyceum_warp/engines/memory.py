"""Memory: what worlds take, whether they fit, and memory set aside for recordings."""

import contextlib
import dataclasses
import gc
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from lyceum_warp.graphs.rehearsal import rehearse

_KEPT_FREE = 0.1


@dataclasses.dataclass(frozen=True)
class Footprint:
    """Bytes that a batch takes: some in any case, and some for each world; and how many worlds there can be at all."""

    fixed: int
    each: int
    most: float = math.inf

    @classmethod
    def of(cls, few: int, more: int, sizes: Sequence[int]) -> "Footprint":
        """From what few worlds and more worlds take."""
        each = -(-(sizes[1] - sizes[0]) // (more - few))
        return cls(max(0, sizes[0] - few * each), each)

    def __add__(self, other: "Footprint") -> "Footprint":
        return Footprint(self.fixed + other.fixed, self.each + other.each, min(self.most, other.most))

    def largest(self, free: int) -> int:
        """The largest number of worlds for so many free bytes; a tenth of them is left for everything else."""
        return max(0, int(min(self.most, ((1 - _KEPT_FREE) * free - self.fixed) // max(1, self.each))))


def free_memory(device: wp.Device) -> int | None:
    """Bytes that are free on a device, or None if that can't be known."""
    if device.is_cuda:
        return int(device.free_memory)
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")) * 1024
    except (OSError, StopIteration, ValueError, IndexError):
        return None


def check_fit(footprint: Footprint, nworld: int, device: wp.Device, held: int = 0) -> None:
    """Refuse a batch that does not fit into what is free, before more is allocated.

    Args:
        footprint: What the batch takes in all.
        nworld: Number of worlds.
        device: Where.
        held: Bytes of it that the batch has already.

    Raises:
        ValueError: It does not; the message names the largest that would.
    """
    free = free_memory(device)
    if free is not None and nworld > footprint.largest(free + held) and device.is_cuda:
        gc.collect()  # environments that nobody has any more, and what torch keeps for later
        torch.cuda.empty_cache()
        free = free_memory(device)
    if free is None or nworld <= (most := footprint.largest(free := free + held)):
        return
    need = footprint.fixed + nworld * footprint.each
    hint = f"use nworld={most} at most" if most else "not even one does"
    raise ValueError(
        f"{nworld} worlds do not fit into the memory of {device.alias}: they need {need / 1e9:.3g} GB "
        f"({footprint.each / 1e3:.3g} kB each), and {free / 1e9:.3g} GB are free: {hint}, or give less room with "
        "nconmax and njmax"
    )


def bytes_of(*things: Any) -> int:
    """Bytes behind every array that is reachable from some objects, each byte counted once."""
    spans = sorted(set(_spans(things, set())))
    total, end = 0, 0
    for start, stop in spans:
        total += max(0, stop - max(start, end))
        end = max(end, stop)
    return total


def _spans(thing: Any, seen: set[int]) -> Iterator[tuple[int, int]]:
    if id(thing) in seen or thing is None or isinstance(thing, (str, int, float, bool, bytes, type)):
        return
    seen.add(id(thing))
    if isinstance(thing, wp.array):
        if thing.ptr:
            size = thing.capacity or thing.size * wp.types.type_size_in_bytes(thing.dtype)
            yield thing.ptr, thing.ptr + size
    elif isinstance(thing, torch.Tensor):
        start = thing.untyped_storage().data_ptr()
        yield start, start + int(thing.untyped_storage().nbytes())
    elif isinstance(thing, np.ndarray):
        if thing.base is None:
            yield thing.ctypes.data, thing.ctypes.data + thing.nbytes
        else:
            yield from _spans(thing.base, seen)
    elif isinstance(thing, dict):
        for value in thing.values():
            yield from _spans(value, seen)
    elif isinstance(thing, (list, tuple)):
        for value in thing:
            yield from _spans(value, seen)
    elif dataclasses.is_dataclass(thing) or type(thing).__module__.startswith(("lyceum_warp.", "mujoco_warp.")):
        for value in getattr(thing, "__dict__", {}).values():
            yield from _spans(value, seen)


def temporaries(function: Callable[[], None]) -> int:
    """Bytes that a function made of launches allocates for itself, at most at once; it is not run."""
    with rehearse() as rehearsal:
        function()
    return rehearsal.peak


_ALIGNED = 512


class _SetAside:
    """Memory that was set aside, and the part of Warp's protocol for allocators that gives back."""

    def __init__(self, device: wp.Device) -> None:
        self._below = device.get_allocator()
        self._device = device
        self._memory: list[wp.array] = []  # all of it that there ever was: recordings hold its address

    def _set_aside(self, size: int) -> None:
        rows = -(-max(size, 1) // _ALIGNED)  # an axis may be no longer than 2**31
        with wp.ScopedAllocator(self._device, self._below):
            self._memory.append(wp.empty((rows, _ALIGNED), dtype=wp.uint8, device=self._device))

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Give an address back."""
        if not any(memory.ptr <= ptr < memory.ptr + memory.size for memory in self._memory):
            self._below.deallocate(ptr, size_in_bytes)


class Arena(_SetAside):
    """An allocator for what may not allocate: it counts what an unrecorded run asks for, and sets that much aside.

    While it counts, memory comes from the device as ever. Recordings are served from what was set aside; they never
    run at the same time, so that all may use the same memory.

    Args:
        device: A CUDA device.
    """

    def __init__(self, device: wp.Device) -> None:
        super().__init__(device)
        self._size, self._used = 0, 0
        self._serving = False

    def open(self) -> None:
        """Begin again at the start."""
        self._used = 0

    @contextlib.contextmanager
    def counting(self) -> Iterator[None]:
        """Count what is allocated between one ``open`` and the next, and set the most aside at the end."""
        self._serving = False
        with wp.ScopedAllocator(self._device, self):
            yield
        if not self._memory or self._memory[-1].size < self._size:
            self._set_aside(self._size)

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Hand out what was set aside."""
        self._serving = True
        try:
            with wp.ScopedAllocator(self._device, self):
                yield
        finally:
            self._serving = False

    def allocate(self, size_in_bytes: int) -> int:
        """An address with so many bytes behind it."""
        start = self._used
        self._used += _aligned(size_in_bytes)
        if not self._serving:
            self._size = max(self._size, self._used)
            return int(self._below.allocate(size_in_bytes))
        if not self._memory or self._used > self._memory[-1].size:
            raise RuntimeError("a recording asks for more memory than was set aside: it has to run unrecorded before")
        return int(self._memory[-1].ptr) + start


class Scratch(_SetAside):
    """An allocator for the buffers that Warp's deterministic launches sort their atomic additions in.

    Warp has a recording keep those of each of its launches, which takes about a hundred times a world's own memory. But
    launches follow one another, and each begins by clearing its buffers, so that all may have the same memory. Warp
    clears them while it records, too: no recording may run then.

    Args:
        device: A CUDA device.
    """

    def __init__(self, device: wp.Device) -> None:
        super().__init__(device)
        self._block, self._used, self._now = 0, 0, 0
        self.peak = 0
        """Bytes that were handed out, at most, between one ``open`` and the next."""
        self.largest = 0
        """Bytes that were handed out at once, at most."""

    def set_aside(self, size: int) -> None:
        """Have so many bytes ready, in one piece; more are taken when they are asked for, piece by piece."""
        self._set_aside(size)

    def open(self) -> None:
        """Begin again at the start: the launches before are over when those that follow run."""
        self._block, self._used, self._now = 0, 0, 0

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Hand out what was set aside to launches that are being recorded; nothing changes for others."""
        self.open()
        with wp.ScopedAllocator(self._device, self):
            yield

    def allocate(self, size_in_bytes: int) -> int:
        """An address with so many bytes behind it."""
        # Warp makes these buffers beside the recording, on a stream of their own; all else belongs into it
        if not self._device.is_capturing or self._device.stream.is_capturing:
            return int(self._below.allocate(size_in_bytes))
        size = _aligned(size_in_bytes)
        self._now += size
        self.peak, self.largest = max(self.peak, self._now), max(self.largest, size)
        while self._block < len(self._memory) and self._used + size > self._memory[self._block].size:
            self._block, self._used = self._block + 1, 0
        if self._block == len(self._memory):
            self._set_aside(size)
        self._used += size
        return int(self._memory[self._block].ptr) + self._used - size


def _aligned(size: int) -> int:
    return -(-size // _ALIGNED) * _ALIGNED
