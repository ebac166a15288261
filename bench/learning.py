"""Learning curves of NPG over several seeds, each in a process of its own.

python bench/learning.py hopper --seeds 0 1 2 --iterations 100 --out curves
"""

import concurrent.futures
import dataclasses
import json
import multiprocessing
import statistics
import time
from pathlib import Path
from typing import Any

import records
import torch
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw


@dataclasses.dataclass(frozen=True)
class Options:
    """Learning curves of NPG."""

    task: tyro.conf.Positional[str]
    """Task."""
    config: lw.NPGConfig = dataclasses.field(default_factory=lw.NPGConfig)
    """Hyperparameters."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds."""
    iterations: int = 100
    """Iterations of each run."""
    nworld: int = 32
    """Worlds."""
    device: str = "cpu"
    """Device."""
    engine: str = "auto"
    """Engine."""
    integrator: str | None = None
    """Another integrator than the model's: euler, rk4, implicit or implicitfast."""
    target: float | None = None
    """A mean return; the seconds until the stochastic policy reaches it are printed."""
    processes: int = 1
    """Runs at the same time; each then has one thread."""
    out: Path | None = None
    """Folder for the curves as JSON."""


def run(options: Options, seed: int) -> list[dict[str, Any]]:
    """One run; returns its iterations and adds the seconds since its start."""
    nthread = None
    if options.processes > 1:
        torch.set_num_threads(1)
        nthread = 1 if options.device == "cpu" else None
    env = lw.make(
        options.task, nworld=options.nworld, seed=seed, device=options.device, engine=options.engine,
        integrator=options.integrator, nthread=nthread,
    )  # fmt: skip
    npg = lw.NPG(env, config=options.config, seed=seed)
    start, rows = time.perf_counter(), []
    for iteration in npg:
        row = dataclasses.asdict(iteration)
        rows.append(row | {"seed": seed, "seconds": time.perf_counter() - start})
        if iteration.iteration == options.iterations:
            return rows
    raise AssertionError("NPG never ends by itself")


def main(options: Options) -> None:
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.processes, mp_context=context) as pool:
        runs = list(pool.map(run, [options] * len(options.seeds), options.seeds))
    table = Table("iteration", "samples", "return", "min .. max over seeds", "mean policy", "min .. max over seeds")
    for i in range(options.iterations):
        if (i + 1) % max(1, options.iterations // 10) and i > 0:
            continue
        rows = [rows[i] for rows in runs]
        table.add_row(str(i + 1), f"{rows[0]['samples']:,}", *spread(rows, "return_mean"), *spread(rows, "mean_return"))
    console = Console(width=130)
    console.print(table)
    sample = statistics.median(row["time_sample"] for rows in runs for row in rows)
    learn = statistics.median(
        row["time_gradient"] + row["time_solve"] + row["time_value"] for rows in runs for row in rows
    )
    terminal = [statistics.mean(row["terminal_reward"] for row in rows[-10:]) for rows in runs]
    console.print(f"median seconds of an iteration: sampling {sample:.2f}, learning {learn:.2f}")
    console.print(f"mean terminal reward of the last ten iterations, each seed: {[round(x, 3) for x in terminal]}")
    if options.target is not None:
        for seed, rows in zip(options.seeds, runs, strict=True):
            first = next((row for row in rows if row["return_mean"] >= options.target), None)
            told = "not reached" if first is None else f"{first['seconds']:.1f} s, {first['samples']:,} samples"
            console.print(f"a mean return of {options.target:g}, seed {seed}: {told}")
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        record = {
            "versions": records.context(options.device),
            "options": dataclasses.asdict(options) | {"out": str(options.out)},
            "rows": [row for rows in runs for row in rows],
        }
        (options.out / f"{options.task}.json").write_text(json.dumps(record, indent=1) + "\n")


def spread(rows: list[dict[str, Any]], key: str) -> tuple[str, str]:
    values = [row[key] for row in rows if row[key] is not None]
    if not values:
        return "", ""
    return f"{statistics.mean(values):.0f}", f"{min(values):.0f} .. {max(values):.0f}"


if __name__ == "__main__":
    main(tyro.cli(Options))
