"""Compile kernels ahead of time, on all cores, with progress on stderr.

Warp compiles a module silently at the first launch of one of its kernels. On a new GPU, compilation takes a minute or
more per task. ``compile_ahead`` finds the launches of a step, and compiles in parallel the modules that are not in
Warp's cache.
"""

import concurrent.futures
from collections.abc import Callable

import warp as wp

from lyceum_warp.graphs.rehearsal import rehearse
from lyceum_warp.support.long_work import LongWork
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.support.upstream import is_compiled


def compile_ahead(function: Callable[[], None], device: wp.Device, purpose: str) -> None:
    """Compile the uncached kernels that a function launches, and report progress on stderr.

    The function runs without its kernels, so its arrays may contain garbage afterwards. ``purpose``, such as "hopper",
    is part of the report.
    """
    with rehearse() as modules:
        function()
    wanted = list(dict.fromkeys((module, _block(device, block)) for module, block in modules))
    missing = [(module, block) for module, block in wanted if not is_compiled(module, block, device)]
    if not missing:
        return
    with LongWork(f"compiling kernels of {purpose} for {device.alias}", "modules", wait=0.0) as report:
        report(0, len(missing))
        pool = concurrent.futures.ThreadPoolExecutor(min(cpu_cores(), len(missing)))
        try:
            futures = [
                pool.submit(wp.force_load, device, modules=[module], block_dim=block, max_workers=0)
                for module, block in missing
            ]
            for done, future in enumerate(concurrent.futures.as_completed(futures), 1):
                future.result()
                report(done, len(missing))
        finally:
            pool.shutdown(cancel_futures=True)  # cancel remaining modules after an error or Ctrl-C


def _block(device: wp.Device, block: int | None) -> int:
    return 1 if device.is_cpu else block or 256
