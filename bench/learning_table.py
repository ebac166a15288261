"""NPG at one million samples on Gymnasium's tasks: one setting for all, or a setting of each task's own.

python bench/learning_table.py --processes 16 --out bench/results/learning_table.jsonl
python bench/learning_table.py --search --seeds 100 101 --processes 16 --out bench/results/learning_search.jsonl
python bench/learning_table.py --own bench/results/learning_search.jsonl --processes 16 \\
    --out bench/results/learning_table.jsonl

A run has one core. Its results are the mean policy's return over 16 episodes at the end and at its best evaluation.
The search tries ``TRIED``; a task's own setting is the one whose mean policy is best at the end, on average over the
seeds of the search, which the table does not use.
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

DEFAULT = "default"

_NEAR = {"gamma": 0.99, "lam": 0.95, "value_epochs": 5}

_NO_FORCES = {"param": ("include_cfrc_ext_in_observation=False", "contact_cost_weight=0")}
"""Ant and humanoid as in the versions that Tianshou's figures are of, where contact forces were always 0."""

SETTINGS: dict[str, dict[str, Any]] = {
    DEFAULT: {},
    "gamma 0.99": {"gamma": 0.99, "lam": 0.95},
    "gamma 0.999": {"gamma": 0.999},
    "5,000 samples": {"samples": 5000},
    "less noise": {"log_std": -1.0},
    "gamma 0.97, less noise": {"gamma": 0.97, "log_std": -1.0},
    "5,000 samples, gamma 0.99": {"samples": 5000, **_NEAR},
    "5,000 samples, gamma 0.99, less noise": {"samples": 5000, **_NEAR, "log_std": -1.0},
    "2,000 samples, gamma 0.99": {"samples": 2000, **_NEAR},
    "2,000 samples, gamma 0.99, less noise": {"samples": 2000, **_NEAR, "log_std": -1.0},
    "1,000 samples, gamma 0.99, less noise": {"samples": 1000, **_NEAR, "log_std": -1.0},
    "2,000 samples, gamma 0.99, little noise": {"samples": 2000, **_NEAR, "log_std": -1.5},
    "2,000 samples, gamma 0.99, no contact forces": {"samples": 2000, **_NEAR, **_NO_FORCES},
    "2,000 samples, gamma 0.99, less noise, no contact forces": {
        "samples": 2000,
        **_NEAR,
        "log_std": -1.0,
        **_NO_FORCES,
    },
    "2,000 samples, gamma 0.99, little noise, no contact forces": {
        "samples": 2000,
        **_NEAR,
        "log_std": -1.5,
        **_NO_FORCES,
    },
    "beginnings": {"samples": 5000, "rollout": "episodes", "min_log_std": -1.5, "delta": 0.05},
}
"""What differs from the default, "param" in the task and the rest in the hyperparameters. "beginnings" samples the
first 79 steps of an episode in each of 64 worlds."""

_LONG = (DEFAULT, "gamma 0.99", "less noise", "2,000 samples, gamma 0.99")
_GAITS = (DEFAULT, "gamma 0.99", "5,000 samples", "5,000 samples, gamma 0.99")

TRIED: dict[str, tuple[str, ...]] = {
    "humanoid": _LONG, "humanoid_standup": _LONG, "ant": (*_LONG, "5,000 samples, gamma 0.99"),
    "pusher": (DEFAULT, "gamma 0.97, less noise"), "reacher": (DEFAULT, "gamma 0.97, less noise"),
    "walker2d": _GAITS, "half_cheetah": _GAITS, "hopper": _GAITS, "swimmer": (DEFAULT, "5,000 samples", "gamma 0.999"),
    "inverted_double_pendulum": (DEFAULT, "beginnings"), "inverted_pendulum": (DEFAULT, "beginnings"),
}  # fmt: skip
"""Settings that the search tries."""


@dataclasses.dataclass(frozen=True)
class Options:
    """A table of NPG's results."""

    tasks: tyro.conf.Positional[tuple[str, ...]] = TASKS
    """Tasks."""
    config: lw.NPGConfig = dataclasses.field(default_factory=lw.NPGConfig)
    """Hyperparameters."""
    setting: str | None = None
    """One of ``SETTINGS`` for all tasks; by default "default"."""
    search: bool = False
    """Whether to try the settings of ``TRIED``."""
    own: Path | None = None
    """The file of a search: each task gets the setting that was best there."""
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


def case(options: Options, task: str, setting: str) -> learning.Options:
    """The settings of a task's runs."""
    words = dict(SETTINGS[setting])
    param = words.pop("param", ())
    config = dataclasses.replace(options.config, **words)
    each = -(-(config.samples or 10_000) // options.nworld) * options.nworld
    iterations = -(-options.samples // each)
    # evaluations step, too: about twenty of them, the last one at the end
    every = max(1, iterations // 20)
    iterations = -(-iterations // every) * every
    config = dataclasses.replace(config, mean_every=every)
    return learning.Options(task, config=config, iterations=iterations, nworld=options.nworld, param=param, processes=2)


def chosen(search: Path | None, tasks: tuple[str, ...]) -> dict[str, str]:
    """The setting of each task: the best one of a search that leaves the task as it is, or the default."""
    if search is None:
        return dict.fromkeys(tasks, DEFAULT)
    found: dict[str, dict[str, list[float]]] = {}
    for r in read(search):
        if "param" in SETTINGS[r["setting"]]:
            continue
        found.setdefault(r["task"], {}).setdefault(r["setting"], []).append(r["final"])
    if missing := [task for task in tasks if task not in found]:
        raise SystemExit(f"{search} has no run of {', '.join(missing)}: search again with these tasks")
    return {task: max(found[task], key=lambda s: statistics.fmean(found[task][s])) for task in tasks}


def read(path: Path | None) -> list[dict[str, Any]]:
    """The runs of a file."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path is not None and path.exists() else []


def run(options: Options, task: str, setting: str, seed: int) -> dict[str, Any]:
    """One run: its curve and how it ended."""
    settings, start = case(options, task, setting), time.perf_counter()
    rows = learning.run(settings, seed)
    evaluated = [row for row in rows if row["mean_return"] is not None]
    return {
        "task": task, "setting": setting, "seed": seed, "nworld": settings.nworld,
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
    if options.setting is not None:
        if options.setting not in SETTINGS:
            raise SystemExit(f"setting must be one of {', '.join(map(repr, SETTINGS))}, not {options.setting!r}")
        cases = [(task, options.setting) for task in options.tasks]
    elif options.search:
        cases = [(task, setting) for task in options.tasks for setting in TRIED.get(task, tuple(SETTINGS))]
    else:
        cases = list(chosen(options.own, options.tasks).items())
    done = read(options.out)
    have = {(r["task"], r["setting"], r["seed"]) for r in done}
    wanted = [(*case, seed) for case in cases for seed in options.seeds if (*case, seed) not in have]
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.processes, mp_context=context) as pool:
        runs = [pool.submit(run, options, *case) for case in wanted]
        for future in concurrent.futures.as_completed(runs):
            result = future.result()
            done.append(result)
            if options.out is not None:
                options.out.parent.mkdir(parents=True, exist_ok=True)
                with options.out.open("a") as file:
                    file.write(json.dumps(result) + "\n")
            ended = f"{result['final']:.1f}, {result['seconds']:.0f} s"
            print(f"{result['task']}, {result['setting']}, seed {result['seed']}: {ended}", flush=True)
    rows = {
        case: [r for r in done if (r["task"], r["setting"]) == case and r["seed"] in options.seeds] for case in cases
    }
    Console(width=150).print(table(rows))


def table(cases: dict[tuple[str, str], list[dict[str, Any]]]) -> Table:
    """The results by task and setting."""
    grid = Table(
        "task", "setting", "seeds", "mean policy at the end", "best evaluation", "with noise", "published", "seconds"
    )
    for (task, setting), runs in cases.items():
        if not runs:
            continue
        published = "{:g} ± {:g}".format(*PUBLISHED[task]) if task in PUBLISHED else ""
        cells = [spread([r[name] for r in runs]) for name in ("final", "best", "noisy")]
        seconds = f"{statistics.fmean(r['seconds'] for r in runs):.0f}"
        grid.add_row(task, setting, str(len(runs)), *cells, published, seconds)
    return grid


def spread(values: list[float]) -> str:
    """Mean ± standard deviation (smallest to largest)."""
    values = [value for value in values if not math.isnan(value)]
    if not values:
        return "-"
    return f"{statistics.fmean(values):.0f} ± {statistics.pstdev(values):.0f} ({min(values):.0f} to {max(values):.0f})"


if __name__ == "__main__":
    main(tyro.cli(Options))
