"""Compile kernels ahead of time, on all cores, with progress on stderr.

Warp compiles a module silently at the first launch of one of its kernels. On a new GPU, compilation takes a minute or
more per task. ``compile_ahead`` finds the launches of a step, and compiles in parallel the modules that are not in
Warp's cache.
"""

import concurrent.futures
import dataclasses
import sys
import time
from collections.abc import Callable
from typing import Any

import warp as wp
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from lyceum_warp.graphs.rehearsal import rehearse
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.support.upstream import is_compiled


@dataclasses.dataclass(frozen=True)
class Built:
    """Numbers of modules that were compiled and that were already in the cache, and the seconds of compilation."""

    modules: int = 0
    known: int = 0
    seconds: float = 0.0


def compile_ahead(function: Callable[[], None], device: wp.Device, purpose: str) -> Built:
    """Compile the uncached kernels that a function launches, and report progress on stderr.

    The function runs without its kernels, so its arrays may contain garbage afterwards. ``purpose``, such as "hopper",
    is part of the report.
    """
    with rehearse() as rehearsal:
        function()
    wanted = list(dict.fromkeys((module, _block(device, block)) for module, block in rehearsal.modules))
    missing = [(module, block) for module, block in wanted if not is_compiled(module, block, device)]
    if not missing:
        return Built(known=len(wanted))
    start = time.perf_counter()
    with _Report(len(missing), purpose, device) as report:
        pool = concurrent.futures.ThreadPoolExecutor(min(cpu_cores(), len(missing)))
        try:
            futures = [pool.submit(_load, module, block, device) for module, block in missing]
            for future in concurrent.futures.as_completed(futures):
                report(*future.result())
        finally:
            pool.shutdown(cancel_futures=True)
    return Built(len(missing), len(wanted) - len(missing), time.perf_counter() - start)


def _load(module: Any, block: int, device: wp.Device) -> tuple[str, float]:
    start = time.perf_counter()
    wp.force_load(device, modules=[module], block_dim=block, max_workers=0)
    return module.name, time.perf_counter() - start


def _block(device: wp.Device, block: int | None) -> int:
    return 1 if device.is_cpu else block or 256


class _Report:
    """Prints a progress bar on a terminal, and elsewhere a line for each module."""

    def __init__(self, total: int, purpose: str, device: wp.Device) -> None:
        self._text = f"compiling kernels of {purpose} for {device.alias}"
        self._total, self._done = total, 0
        console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description}"), BarColumn(bar_width=12), MofNCompleteColumn(), TimeElapsedColumn(),
            TextColumn("{task.fields[last]}"), console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self._bar = self._progress.add_task(self._text, total=total, last="")
        self._lines = not console.is_terminal

    def __enter__(self) -> "_Report":
        self._progress.start()
        if self._lines:
            cores = f"{cpu_cores()} cores" if cpu_cores() > 1 else "1 core"
            print(f"{self._text}: {self._total} modules on {cores}, needed only once", file=sys.stderr, flush=True)
        return self

    def __call__(self, module: str, seconds: float) -> None:
        self._done += 1
        name = module.removeprefix("mujoco_warp._src.").removeprefix("lyceum_warp.").partition("__locals__")[0]
        self._progress.update(self._bar, completed=self._done, last=name)
        if self._lines:
            print(f"  {self._done}/{self._total} {name} {seconds:.1f} s", file=sys.stderr, flush=True)

    def __exit__(self, *exception: object) -> None:
        self._progress.stop()
