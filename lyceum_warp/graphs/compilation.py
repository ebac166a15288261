"""Compile kernels ahead of time, on all cores, with progress on stderr.

Warp compiles a module silently at the first launch of one of its kernels. On a new GPU, compilation takes a minute or
more per task. ``compile_ahead`` finds the launches of a step, and compiles in parallel the modules that are not in
Warp's cache.
"""

import concurrent.futures
import contextlib
import threading
import types
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp

from lyceum_warp.support.arrays import launches_as_on_cuda
from lyceum_warp.support.long_work import LongWork
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.support.upstream import compile_module, is_compiled, replaced_in_this_thread


def compile_ahead(
    function: Callable[[], object], device: wp.Device | None, purpose: str, *, arch: int | None = None
) -> None:
    """Compile the uncached kernels that a function launches, and report progress on stderr.

    The function runs without its kernels, so its arrays may contain garbage afterwards.

    Args:
        function: The function. With ``arch``, it runs on the CPU and launches what it would launch on a GPU.
        device: The device, or None with ``arch``.
        purpose: A part of the report, such as "hopper".
        arch: A CUDA architecture, such as 90, for which to compile without such a GPU.
    """
    with rehearse(on_cuda=arch is not None) as modules:
        function()
    wanted = list(dict.fromkeys((module, _block(device, block)) for module, block in modules))
    missing = [(module, block) for module, block in wanted if not is_compiled(module, block, device, arch)]
    if not missing:
        return
    target = f"sm_{arch}" if device is None else device.alias
    with LongWork(f"compiling kernels of {purpose} for {target}", "modules", wait=0.0) as report:
        report(0, len(missing))
        pool = concurrent.futures.ThreadPoolExecutor(min(cpu_cores(), len(missing)))
        try:
            futures = [pool.submit(compile_module, module, block, device, arch) for module, block in missing]
            for done, future in enumerate(concurrent.futures.as_completed(futures), 1):
                future.result()
                report(done, len(missing))
        finally:
            pool.shutdown(cancel_futures=True)  # cancel remaining modules after an error or Ctrl-C


def _block(device: wp.Device | None, block: int | None) -> int:
    return 1 if device is not None and device.is_cpu else block or 256


_lock = threading.RLock()


@contextlib.contextmanager
def rehearse(*, on_cuda: bool = False) -> Iterator[dict[tuple[Any, int | None], None]]:
    """List the modules of this thread's launches instead of running the kernels; graph branches and loops run once.

    Kernels do not run, but copies and allocations do. Arrays may therefore contain garbage afterwards. Only one thread
    can do this at a time; other threads launch kernels as usual.

    Args:
        on_cuda: Whether to launch what a CUDA device would need, although the arrays are on the CPU.

    Yields:
        Modules and block sizes in launch order, as the keys of a dict. A block size of None is Warp's default.
    """
    modules: dict[tuple[Any, int | None], None] = {}

    def launch(kernel: Any, dim: Any = None, *args: Any, block_dim: int | None = None, **kwargs: Any) -> None:
        # a launch of size 0 loads no module; the module of a generic kernel depends on the argument types
        if np.prod(dim) and not kernel.is_generic:
            modules[kernel.module, block_dim] = None

    functions: dict[str, Callable[..., Any]] = dict.fromkeys(("launch", "launch_tiled"), launch)
    functions |= {"capture_while": _loop, "capture_if": _branch}
    # sorts and scans would read garbage
    functions |= dict.fromkeys(("radix_sort_pairs", "segmented_sort_pairs", "array_scan"), _nothing)
    if on_cuda:
        real, current = wp.get_device, types.SimpleNamespace(is_cuda=True, is_cpu=False, sm_count=1)
        functions["get_device"] = lambda device=None: current if device is None else real(device)
        functions["is_conditional_graph_supported"] = lambda: True
    with _lock, replaced_in_this_thread(functions), launches_as_on_cuda() if on_cuda else contextlib.nullcontext():
        yield modules


def _loop(condition: Any, while_body: Any, stream: Any = None, **kwargs: Any) -> None:
    while_body(**kwargs)


def _branch(condition: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **kwargs: Any) -> None:
    for body in (on_true, on_false):
        if callable(body):
            body(**kwargs)


def _nothing(*args: Any, **kwargs: Any) -> None:
    pass
