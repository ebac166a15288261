"""NPG at one million samples on Gymnasium's tasks: one setting for all, or the settings of each task's own.

python bench/learning_table.py --processes 16 --out bench/results/learning_table.jsonl
python bench/learning_table.py hopper swimmer --seeds 0 1 --own

A run has one core. Its results are the mean policy's return over 16 episodes at the end and at its best evaluation.
Beside them stand the best means of Tianshou's NPG at one million samples, published for older versions of the
environments: https://tianshou.org/en/stable/01_tutorials/06_benchmark.html
"""

import concurrent.futures
import dataclasses
import json
import math
import multiprocessing
import statistics
import time
from pathlib import Path
from typing import Any

import learning
import measurements
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw

PUBLISHED = {
    "ant": (2358, 518), "half_cheetah": (3485, 717), "hopper": (1915, 551), "humanoid": (765, 91),
    "swimmer": (31.5, 8), "walker2d": (2503, 963),
}  # fmt: skip
"""Mean and standard deviation of Tianshou's NPG."""

TASKS = (
    "humanoid", "ant", "humanoid_standup", "pusher", "walker2d", "half_cheetah", "hopper", "swimmer", "reacher",
    "inverted_double_pendulum", "inverted_pendulum",
)  # fmt: skip
"""Gymnasium's tasks, those that take longest first."""

OWN: dict[str, dict[str, Any]] = {}
"""Settings of each task's own; "nworld" is the number of worlds, the others are NPG's."""


@dataclasses.dataclass(frozen=True)
class Options:
    """A table of NPG's results."""

    tasks: tyro.conf.Positional[tuple[str, ...]] = TASKS
    """Tasks."""
    config: lw.NPGConfig = dataclasses.field(default_factory=lw.NPGConfig)
    """Hyperparameters."""
    own: bool = False
    """Whether to use the settings of each task's own."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds."""
    samples: int = 1_000_000
    """Samples of a run."""
    nworld: int = 64
    """Worlds."""
    processes: int = 2
    """Runs at the same time."""
    out: Path | None = None
    """File for the runs, one line of JSON each. Runs that it holds already are not repeated."""


def case(options: Options, task: str) -> learning.Options:
    """The settings of a task's runs."""
    own = dict(OWN.get(task, {})) if options.own else {}
    nworld = own.pop("nworld", options.nworld)
    config = dataclasses.replace(options.config, **own)
    each = -(-(config.samples or 10_000) // nworld) * nworld
    iterations = -(-options.samples // each)
    # evaluations step, too: about twenty of them, the last one at the end
    every = max(1, iterations // 20)
    iterations = -(-iterations // every) * every
    config = dataclasses.replace(config, mean_every=every)
    return learning.Options(task, config=config, iterations=iterations, nworld=nworld, processes=2)


def run(options: Options, task: str, seed: int) -> dict[str, Any]:
    """One run: its curve and how it ended."""
    settings, start = case(options, task), time.perf_counter()
    rows = learning.run(settings, seed)
    evaluated = [row for row in rows if row["mean_return"] is not None]
    return {
        "task": task, "seed": seed, "own": options.own, "nworld": settings.nworld,
        "config": dataclasses.asdict(settings.config),
        "final": evaluated[-1]["mean_return"], "best": max(row["mean_return"] for row in evaluated),
        "noisy": statistics.fmean(row["return_mean"] for row in rows[-max(1, len(rows) // 20) :]),
        "samples": rows[-1]["samples"], "seconds": time.perf_counter() - start,
        "curve": [[row["samples"], round(row["mean_return"], 1)] for row in evaluated],
        "shortened": sum(row["step_fraction"] < 1.0 for row in rows) / len(rows),
        "outliers": sum(row["outliers"] for row in rows), "faults": sum(row["faults"] for row in rows),
        "context": measurements.context("cpu"),
    }  # fmt: skip


def main(options: Options) -> None:
    done: list[dict[str, Any]] = []
    if options.out is not None and options.out.exists():
        done = [json.loads(line) for line in options.out.read_text().splitlines()]
    have = {(r["task"], r["seed"], r["own"]) for r in done}
    wanted = [(t, s) for t in options.tasks for s in options.seeds if (t, s, options.own) not in have]
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.processes, mp_context=context) as pool:
        runs = [pool.submit(run, options, task, seed) for task, seed in wanted]
        for future in concurrent.futures.as_completed(runs):
            result = future.result()
            done.append(result)
            if options.out is not None:
                options.out.parent.mkdir(parents=True, exist_ok=True)
                with options.out.open("a") as file:
                    file.write(json.dumps(result) + "\n")
            ended = f"{result['final']:.1f}, {result['seconds']:.0f} s"
            print(f"{result['task']} seed {result['seed']}: {ended}", flush=True)
    Console(width=130).print(table([r for r in done if r["task"] in options.tasks and r["own"] == options.own]))


def table(runs: list[dict[str, Any]]) -> Table:
    """The results by task."""
    grid = Table("task", "seeds", "mean policy at the end", "best evaluation", "with noise", "published", "seconds")
    for task in TASKS + tuple(sorted({r["task"] for r in runs} - set(TASKS))):
        own = [r for r in runs if r["task"] == task]
        if not own:
            continue
        published = "{:g} ± {:g}".format(*PUBLISHED[task]) if task in PUBLISHED else ""
        cells = [spread([r[name] for r in own]) for name in ("final", "best", "noisy")]
        grid.add_row(task, str(len(own)), *cells, published, f"{statistics.fmean(r['seconds'] for r in own):.0f}")
    return grid


def spread(values: list[float]) -> str:
    """Mean ± standard deviation (smallest to largest)."""
    values = [value for value in values if not math.isnan(value)]
    if not values:
        return "-"
    return f"{statistics.fmean(values):.0f} ± {statistics.pstdev(values):.0f} ({min(values):.0f} to {max(values):.0f})"


if __name__ == "__main__":
    main(tyro.cli(Options))
