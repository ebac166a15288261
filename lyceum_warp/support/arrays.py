"""View Warp arrays as other arrays or as torch tensors, and launch kernels over worlds."""

import contextlib
from collections.abc import Sequence
from contextvars import ContextVar
from typing import Any

import numpy as np
import torch
import warp as wp

from lyceum_warp.support.settings import temporarily

WORLDS_A_BLOCK = 32
"""Threads in a CUDA block, for kernels with one thread per world. Larger blocks would leave most multiprocessors
idle."""

_SPARE = 256
"""Number of elements that ``with_memory`` allocates."""


def alias(array: wp.array, dtype: type, shape: tuple[int, ...], strides: tuple[int, ...] | None = None) -> wp.array:
    """View an array's memory with a different type, shape or strides, and keep the memory alive."""
    view: Any = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, strides=strides, device=array.device)
    view.owner = array
    return view


def flat(array: wp.array) -> wp.array:
    """View an array's memory as (nworld, n) float32, so that one kernel can copy arrays of any type."""
    n = array.size * wp.types.type_size_in_bytes(array.dtype) // 4 // max(array.shape[0], 1)
    return alias(array, wp.float32, (array.shape[0], n))


def repeated(row: wp.array, count: int) -> wp.array:
    """View a row as an array (count, n) of equal rows."""
    return alias(row, row.dtype, (count, row.size), (0, *row.strides))


def shared_rows(row: np.ndarray, dtype: type, count: int, device: wp.Device) -> wp.array:
    """Make a read-only array (count, ...) of equal rows, which share the memory of one row (stride 0)."""
    single: Any = wp.array(row[None], dtype=dtype, device=device)
    return alias(single, dtype, (count, *single.shape[1:]), (0, *single.strides[1:]))


def with_memory(array: wp.array) -> wp.array:
    """Give memory to an empty array, and return any other array unchanged.

    Without this memory, a task that reads an element by mistake would crash the process.
    """
    if array.size:
        return array
    return alias(wp.zeros(_SPARE, dtype=array.dtype, device=array.device), array.dtype, array.shape)


def zeros_of(struct: Any, shape: int = 0, /, **shapes: Any) -> Any:
    """Make an instance of a struct with arrays of zeros of the given shape. ``shapes`` has other shapes by name."""
    instance = struct()
    for name, field in struct.vars.items():
        if hasattr(field.type, "dtype"):
            setattr(instance, name, wp.zeros(shapes.get(name, shape), dtype=field.type.dtype))
    return instance


def torch_view(array: wp.array) -> torch.Tensor:
    """Return a torch tensor that shares an array's memory."""
    return wp.to_torch(array, requires_grad=False)


def words(pictures: torch.Tensor) -> torch.Tensor:
    """View pictures, (nworld, height, width, channels), as rows of float32, so that a kernel for rows copies them."""
    return pictures.flatten(1).view(torch.float32)


_PART: ContextVar[tuple[int, int]] = ContextVar("_PART", default=(0, 1))
"""The part of the worlds to which launches are restricted: the index of the part, and the number of parts."""


def part_of_worlds(part: int, parts: int) -> contextlib.AbstractContextManager[None]:
    """Restrict the launches of this module to one of several equal parts of the worlds."""
    return temporarily(_PART.set, (part, parts), _PART.get())


def _launch(kernel: wp.Kernel, dim: Sequence[int], axis: int, args: Sequence[Any], device: Any, **options: Any) -> None:
    part, parts = _PART.get()
    first, end = (dim[axis] * k // parts for k in (part, part + 1))
    if end > first:
        size = (*dim[:axis], end - first, *dim[axis + 1 :])
        wp.launch(kernel, size, [*args, first], device=device, **options)


_AS_ON_CUDA: ContextVar[bool] = ContextVar("_AS_ON_CUDA", default=False)
"""Whether to launch on the CPU with the block sizes of a CUDA device."""


def launches_as_on_cuda() -> contextlib.AbstractContextManager[None]:
    """Give the launches of this module the block sizes of a CUDA device, to list the modules that they need there."""
    return temporarily(_AS_ON_CUDA.set, True, _AS_ON_CUDA.get())


def _on_cuda(device: wp.Device | None) -> bool:
    return _AS_ON_CUDA.get() or wp.get_device(device).is_cuda


def _block(device: wp.Device | None) -> int:
    return WORLDS_A_BLOCK if _on_cuda(device) else 1


def launch_worlds(kernel: wp.Kernel, nworld: int, args: Sequence[Any], device: wp.Device | None) -> None:
    """Launch a kernel with one thread per world. Its last argument is the first world's index."""
    _launch(kernel, (nworld,), 0, args, device, block_dim=_block(device))


def launch_parts(kernel: wp.Kernel, parts: int, nworld: int, args: Sequence[Any], device: wp.Device | None) -> None:
    """Launch a kernel with several threads per world, over (parts, nworld)."""
    _launch(kernel, (parts, nworld), 1, args, device, block_dim=_block(device))


def launch_lanes(kernel: wp.Kernel, nworld: int, args: Sequence[Any], device: wp.Device) -> None:
    """Launch a kernel over (nworld, lanes).

    Its last arguments are the number of lanes and the first world's index. Lanes are threads that share the work on a
    world. The CPU uses one lane. A GPU uses 32 lanes, so that memory access is coalesced.
    """
    lanes = 32 if _on_cuda(device) else 1
    # the block size of launch_worlds, because Warp compiles a task's module for each block size
    _launch(kernel, (nworld, lanes), 0, [*args, lanes], device, block_dim=_block(device))


def launch_rows(kernel: wp.Kernel, mask: wp.array, source: wp.array, target: wp.array) -> None:
    """Launch a copying kernel of ``kernels.state`` over the selected rows of the target, (nworld, n)."""
    if target.size == 0:
        return
    lanes = min(32, target.shape[1]) if _on_cuda(target.device) else 1
    _launch(kernel, (target.shape[0], lanes), 0, [mask, source, target, lanes], target.device)


PAIRS_A_LAUNCH = 4
"""Number of pairs of arrays that one launch of ``narrow_four`` or ``widen_four`` copies."""


def launch_several_rows(kernel: wp.Kernel, mask: wp.array, pairs: Sequence[tuple[wp.array, wp.array]]) -> None:
    """Copy the selected rows of several arrays with ``narrow_four`` or ``widen_four`` of ``kernels.state``.

    One launch copies four arrays, because on the CPU a launch takes longer than a few copies.
    """
    pairs = [pair for pair in pairs if pair[1].size]
    for i in range(0, len(pairs), PAIRS_A_LAUNCH):
        some = list(pairs[i : i + PAIRS_A_LAUNCH])
        source, target = some[0]
        some += [(source[:, :0], target[:, :0])] * (PAIRS_A_LAUNCH - len(some))
        launch_worlds(kernel, len(mask), [mask, *(array for pair in some for array in pair)], mask.device)
