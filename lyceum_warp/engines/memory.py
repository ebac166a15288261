"""Memory: what worlds take, whether they fit, and memory set aside for recordings."""

import contextlib
import dataclasses
import gc
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from lyceum_warp.kernels.rehearsal import rehearse

_KEPT_FREE = 0.1


@dataclasses.dataclass(frozen=True)
class Footprint:
    """Bytes that a batch takes: some in any case, and some for each world."""

    fixed: int
    each: int

    def largest(self, free: int) -> int:
        """The largest number of worlds for so many free bytes; a tenth of them is left for everything else."""
        return max(0, int(((1 - _KEPT_FREE) * free - self.fixed) // max(1, self.each)))


def free_memory(device: wp.Device) -> int | None:
    """Bytes that are free on a device, or None if that can't be known."""
    if device.is_cuda:
        return int(device.free_memory)
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")) * 1024
    except (OSError, StopIteration, ValueError, IndexError):
        return None


def check_fit(footprint: Footprint, nworld: int, device: wp.Device) -> None:
    """Refuse a batch that does not fit into what is free, before anything is allocated.

    Raises:
        ValueError: It does not; the message names the largest that would.
    """
    free = free_memory(device)
    if free is not None and nworld > footprint.largest(free) and device.is_cuda:
        gc.collect()  # environments that nobody has any more, and what torch keeps for later
        torch.cuda.empty_cache()
        free = free_memory(device)
    if free is None or nworld <= (most := footprint.largest(free)):
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


class Arena:
    """An allocator for what may not allocate: it counts what an unrecorded run asks for, and sets that much aside.

    While it counts, memory comes from the device as ever. Recordings are served from what was set aside; they never
    run at the same time, so that all may use the same memory.

    Args:
        device: A CUDA device.
    """

    def __init__(self, device: wp.Device) -> None:
        self._below = device.get_allocator()
        self._device = device
        self._size, self._used = 0, 0
        self._serving = False
        self._memory: list[wp.array] = []  # all of it that was ever set aside: older recordings still hold its address

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
            self._memory.append(wp.empty(max(self._size, _ALIGNED), dtype=wp.uint8, device=self._device))

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
        """An address with so many bytes behind it; part of Warp's protocol for allocators."""
        start = self._used
        self._used += -(-size_in_bytes // _ALIGNED) * _ALIGNED
        if not self._serving:
            self._size = max(self._size, self._used)
            return int(self._below.allocate(size_in_bytes))
        if not self._memory or self._used > self._memory[-1].size:
            raise RuntimeError("a recording asks for more memory than was set aside: it has to run unrecorded before")
        return int(self._memory[-1].ptr) + start

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Give an address back; part of Warp's protocol for allocators."""
        if not any(memory.ptr <= ptr < memory.ptr + memory.size for memory in self._memory):
            self._below.deallocate(ptr, size_in_bytes)
