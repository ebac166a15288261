"""Check whether a batch of worlds fits into memory."""

import gc

import torch
import warp as wp

from lyceum_warp.support.machine import free_memory

_FREE_SHARE = 0.1


class NotEnoughMemoryError(ValueError):
    """Raised if a batch of worlds does not fit into the free memory of a device."""


def check_fit(bytes_per_world: float, nworld: int, device: wp.Device, *, model: str = "", held: int = 0) -> None:
    """Check that a batch of worlds fits into the free memory, before its arrays are allocated.

    The batch has already allocated ``held`` bytes.

    Raises:
        NotEnoughMemoryError: The batch does not fit; the message names the largest number of worlds that fit.
    """
    free = free_memory(device)
    if free is not None and nworld > _most(bytes_per_world, free + held):
        gc.collect()  # free environments that are no longer used
        if device.is_cuda:
            torch.cuda.empty_cache()
        free = free_memory(device)
    if free is None or nworld <= (most := _most(bytes_per_world, free + held)):
        return
    worlds = f"{nworld} worlds of {model}" if model else f"{nworld} worlds"
    hint = f"use nworld={most} at most" if most else "not even one world fits"
    raise NotEnoughMemoryError(
        f"{worlds} need about {nworld * bytes_per_world / 1e9:.3g} GB ({bytes_per_world / 1e3:.3g} kB each), and "
        f"{device.alias} has {(free + held) / 1e9:.3g} GB free: {hint}"
    )


def _most(bytes_per_world: float, free: int) -> int:
    return int((1 - _FREE_SHARE) * free / max(bytes_per_world, 1))
