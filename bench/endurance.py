"""Run every task for long under random actions, and count ends of episodes and faults.

lyceum-warp bench endurance
lyceum-warp bench endurance --engine warp --nworld 64 --steps 200
"""

import dataclasses
import sys
import time
from pathlib import Path

import measurements
import numpy as np
import rich.box
import torch
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw


@dataclasses.dataclass(frozen=True)
class Options:
    """Long runs under random actions."""

    tasks: tyro.conf.Positional[tuple[str, ...]] = ()
    """Tasks; by default all."""
    engine: str = "mujoco"
    """Engine."""
    device: str = "cpu"
    """Device."""
    nworld: int = 256
    """Worlds."""
    steps: int = 4000
    """Steps of each world; with 256 worlds, 4,000 are a million world steps."""
    seed: int = 0
    """Seed of the worlds and of the actions."""
    out: Path | None = None
    """File (JSON) of the counts."""


@dataclasses.dataclass(frozen=True)
class Row:
    """Counts of a task."""

    task: str
    world_steps: int
    terminated: int
    truncated: int
    faults: dict[str, int]
    """Number of each kind of fault that occurred."""
    largest_speed: float
    """The largest magnitude in ``qvel`` after a step, in worlds whose episode went on."""
    seconds: float


def run(options: Options, task: str) -> Row:
    """Step one task's worlds from random initial states under random actions."""
    env = lw.make(
        task, engine=options.engine, device=options.device, nworld=options.nworld, seed=options.seed, fields=["qvel"]
    )
    low, high = env.action_space.low, env.action_space.high
    low, high = (np.full(env.action.shape[1], np.inf) if bound is None else bound for bound in (low, high))
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, -1.0), np.where(bounded, high, 1.0)
    middle, reach = (torch.as_tensor(half).to(env.action) for half in ((low + high) / 2, (high - low) / 2))
    generator = torch.Generator(env.action.device).manual_seed(options.seed)
    counts = torch.zeros(2, dtype=torch.int64, device=env.action.device)
    largest = torch.zeros((), device=env.action.device)
    speed = env.field("qvel")
    start = time.perf_counter()
    for _ in range(options.steps):
        noise = torch.rand(env.action.shape, generator=generator, device=env.action.device)
        env.step(middle + reach * (2.0 * noise - 1.0))
        counts += torch.stack([env.terminated.sum(), env.truncated.sum()])
        largest = torch.maximum(largest, speed.abs().max())
    terminated, truncated = counts.tolist()
    faults = {name: count for name, count in env.fault_counts.items() if count}
    return Row(
        task, options.steps * options.nworld, terminated, truncated, faults, float(largest), time.perf_counter() - start
    )


def show(rows: list[Row], console: Console) -> None:
    """Print the counts."""
    table = Table(box=rich.box.SIMPLE)
    for heading in ("task", "world steps", "terminated", "truncated", "largest speed", "seconds"):
        table.add_column(heading, justify="left" if heading == "task" else "right", no_wrap=True)
    table.add_column("faults")
    for row in rows:
        faults = ", ".join(f"{count} {name}" for name, count in row.faults.items()) or "none"
        numbers = (f"{row.world_steps:,}", f"{row.terminated:,}", f"{row.truncated:,}", f"{row.largest_speed:.3g}")
        table.add_row(row.task, *numbers, f"{row.seconds:.1f}", faults)
    console.print(table)


def main() -> int:
    """Run all tasks, print and store the counts; return 1 after a fault or if a model is missing."""
    options = tyro.cli(Options, description=__doc__)
    console, rows, missing = Console(), [], False
    for task in options.tasks or lw.task_names():
        try:
            rows.append(run(options, task))
        except FileNotFoundError as error:  # an extra that is not installed
            console.print(f"{task}: {error}", highlight=False, markup=False)
            missing = True
            continue
        console.print(f"{task}: {rows[-1].seconds:.1f} s", highlight=False)
    show(rows, console)
    if options.out is not None:
        more = {"engine": options.engine, "nworld": options.nworld, "steps": options.steps, "seed": options.seed}
        measurements.write(options.out, rows, options.device, **more)
    return int(missing or any(row.faults for row in rows))


if __name__ == "__main__":
    sys.exit(main())
