"""Count the CPU cores that this process may use, and the free memory."""

import os
from pathlib import Path

import warp as wp


def cpu_cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_memory(device: wp.Device) -> int | None:
    """Return the free bytes on a device, or None if the system does not say."""
    if device.is_cuda:
        return int(device.free_memory)
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")) * 1024
    except (OSError, StopIteration, ValueError, IndexError):
        return None
