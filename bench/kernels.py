"""Time and bandwidth of each of our own kernels, beside what a plain copy reaches on the same device.

    python bench/kernels.py --tasks hopper humanoid --nworld 4096 --device cuda

The launches of a step, and of a plan, are intercepted while they run once without graphs; each is then repeated in a
graph of its own. Its bytes are those of all arrays that it gets, each counted once: a kernel that reads only a part,
the worlds that restart for instance, seems faster than it is, and one that hits caches seems faster than memory.
"""

import collections
import contextlib
import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import measurements
import torch
import tyro
import warp as wp
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw


@dataclasses.dataclass(frozen=True)
class Options:
    """Our kernels' time and bandwidth."""

    tasks: tuple[str, ...] = ("hopper", "half_cheetah", "humanoid")
    """Tasks."""
    nworld: int = 256
    """Worlds of a step, and samples of a plan."""
    horizon: int = 16
    """Steps of a plan."""
    engine: str = "auto"
    """Engine."""
    device: str = "cpu"
    """Device."""
    repeats: int = 20
    """Timings of each kernel; medians are printed."""
    out: Path | None = None
    """JSON file for the results."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One kernel."""

    task: str
    part: str
    kernel: str
    launches: int
    microseconds: float
    """Of one launch, median."""
    megabytes: float
    gigabytes_per_second: float
    of_copy: float
    """Bandwidth by that of a copy."""


Launch = tuple[Callable[..., None], tuple[Any, ...], dict[str, Any]]


@contextlib.contextmanager
def caught() -> Iterator[list[tuple[str, Launch]]]:
    """All launches of kernels while it lasts, by the kernel's name."""
    launches: list[tuple[str, Launch]] = []
    originals = wp.launch, wp.launch_tiled

    def catching(launch: Callable[..., None]) -> Callable[..., None]:
        def call(kernel: wp.Kernel, *args: Any, **options: Any) -> None:
            launches.append((kernel.module.name, kernel.key, (launch, (kernel, *args), options)))
            launch(kernel, *args, **options)

        return call

    wp.launch, wp.launch_tiled = map(catching, originals)
    try:
        yield launches
    finally:
        wp.launch, wp.launch_tiled = originals


def own(launches: list[Any]) -> dict[str, list[Launch]]:
    """Those of our own kernels, by name."""
    found: dict[str, list[Launch]] = collections.defaultdict(list)
    for module, key, launch in launches:
        if module.startswith("lyceum_warp"):
            found[key.rpartition(".")[2].rpartition("__locals__")[2]].append(launch)
    return found


def size(launch: Launch) -> int:
    """Bytes of all arrays that a launch is given, those in structs included."""
    _, args, options = launch
    arrays: dict[int, int] = {}

    def look(value: Any) -> None:
        if isinstance(value, wp.array):
            arrays[value.ptr or 0] = value.size * wp.types.type_size_in_bytes(value.dtype)
        elif isinstance(value, (list, tuple)):
            for item in value:
                look(item)
        elif hasattr(value, "_cls"):
            for name in value._cls.vars:
                look(getattr(value, name))

    look(args[1:])
    look(list(options.values()))
    return sum(arrays.values())


def timed(device: wp.Device, function: Callable[[], None], repeats: int, count: int = 20) -> float:
    """Seconds of one call of something made of launches, out of a graph of many calls."""
    with wp.ScopedDevice(device):
        function()
        with wp.ScopedCapture() as capture:
            for _ in range(count):
                function()
        times = []
        for _ in range(repeats + 2):
            wp.synchronize_device(device)
            start = time.perf_counter()
            wp.capture_launch(capture.graph)
            wp.synchronize_device(device)
            times.append((time.perf_counter() - start) / count)
    return statistics.median(times[2:])


def copy_bandwidth(device: wp.Device) -> float:
    """Bytes a second that a copy of a large array reads and writes."""
    n = 1 << (28 if device.is_cuda else 25)
    source, target = wp.zeros(n, dtype=float, device=device), wp.zeros(n, dtype=float, device=device)
    return 8 * n / timed(device, lambda: wp.copy(target, source), 5, 4)


def measure(task: str, options: Options, bandwidth: float) -> list[Row]:
    where: dict[str, Any] = {"engine": options.engine, "device": options.device}
    env = lw.make(task, nworld=options.nworld, graphs=False, **where)
    plan = lw.MPPI(task, samples=options.nworld, horizon=options.horizon, graphs=False, **where)
    rows = []
    env.step()
    with caught() as launches:
        env.step()
    parts = [("step", env.device, own(launches))]
    plan(plan.state_of())
    with caught() as launches:
        plan(plan.state_of())
    parts.append(("plan", plan.env.device, own(launches)))
    for part, device, found in parts:
        for name, same in found.items():
            biggest = max(same, key=size)
            launch, args, keywords = biggest
            seconds = timed(device, lambda launch=launch, a=args, k=keywords: launch(*a, **k), options.repeats)
            rate = size(biggest) / seconds
            rows.append(
                Row(task, part, name, len(same), 1e6 * seconds, size(biggest) / 1e6, rate / 1e9, rate / bandwidth)
            )
    return rows


def main(options: Options) -> None:
    torch.set_num_threads(1)
    console = Console(width=120)
    device = wp.get_device(options.device)
    bandwidth = copy_bandwidth(device)
    console.print(f"{device.name}: a copy reaches {bandwidth / 1e9:.0f} GB/s; {options.nworld} worlds or samples")
    table = Table("task", "part", "kernel", "launches", "each, µs", "MB", "GB/s", "of a copy's")
    for column in table.columns[3:]:
        column.justify = "right"
    rows = [row for task in options.tasks for row in measure(task, options, bandwidth)]
    for row in rows:
        table.add_row(row.task, row.part, row.kernel, str(row.launches), f"{row.microseconds:.1f}",
                      f"{row.megabytes:.2f}", f"{row.gigabytes_per_second:.1f}", f"{row.of_copy:.0%}")  # fmt: skip
    console.print(table)
    if options.out is not None:
        measurements.write(
            options.out, rows, options.device, nworld=options.nworld, copy_gigabytes_per_second=bandwidth / 1e9
        )


if __name__ == "__main__":
    main(tyro.cli(Options))
