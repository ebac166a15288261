"""The updates of the planner side by side: MPPI, CEM and predictive sampling at equal samples and horizon.

    python bench/planners.py --processes 16 --stop-after 300 --out bench/results/planners.json
    python bench/planners.py --tasks all --planners mppi mppi+plan --processes 16 --stop-after 300 --out plan.json

Every planner has the settings of the task's planning and differs in its own alone. Episodes go in rounds: a round has
as many episodes of each task, with the same seeds for all planners, as take about equally long. Each process has one
thread, and its planning times are those of one core. The file is written after each job: the same command again
continues where the last one stopped. Only seeds that every planner of a task has finished count in the table.
"""

import concurrent.futures
import dataclasses
import itertools
import json
import math
import multiprocessing
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import measurements
import torch
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw
from lyceum_warp.algos.mppi_arguments import task_config
from lyceum_warp.binding.registry import find_task
from lyceum_warp.controllers.control_statistics import wilson

PLANNERS: dict[str, dict[str, Any]] = {
    "mppi": {"update": "mppi", "include_plan": False},
    "mppi+plan": {"update": "mppi", "include_plan": True},
    "mppi, knots": {"update": "mppi", "include_plan": False, "knots": True},
    "mppi+plan, knots": {"update": "mppi", "include_plan": True, "knots": True},
    "cem": {"update": "cem", "include_plan": False},
    "cem, knots": {"update": "cem", "include_plan": False, "knots": True},
    "predictive sampling": {"update": "predictive_sampling", "include_plan": True},
    "predictive sampling, knots": {"update": "predictive_sampling", "include_plan": True, "knots": True},
}
"""Settings of the planners in the table. Knots lie ``Options.knot_steps`` steps apart."""

TASKS: dict[str, tuple[int, int]] = {
    "adroit_pen": (75, 1), "hopper": (150, 1), "half_cheetah": (150, 4), "cartpole_swingup": (200, 4),
    "reach": (75, 20), "adroit_door": (75, 1), "adroit_hammer": (75, 1), "adroit_relocate": (75, 1),
    "aloha_lift": (150, 2), "arm_hand_pickup": (200, 2), "panda_lift": (150, 4), "herb_reach": (100, 4),
    "cartpole": (200, 8),
}  # fmt: skip
"""Steps of an episode, and episodes of a round, for every task with a planning of its own; the longest jobs first."""

COMPARED = ("adroit_pen", "hopper", "half_cheetah", "cartpole_swingup", "reach")


@dataclasses.dataclass(frozen=True)
class Options:
    """Returns and successes of the planner's updates."""

    tasks: tuple[str, ...] = COMPARED
    """Tasks, or "all" for every task with a planning."""
    planners: tuple[str, ...] = tuple(PLANNERS)
    """Names of planners."""
    rounds: int = 100
    """Rounds of episodes."""
    steps: int | None = None
    """Steps of an episode, in place of the table's."""
    knot_steps: int = 4
    """Steps between two knots."""
    spline: str = "cubic"
    """Interpolation between knots."""
    processes: int = 1
    """Jobs at the same time."""
    stop_after: float = math.inf
    """Seconds after which no further job starts. The last ones take up to three minutes longer."""
    out: Path | None = None
    """JSON file for the episodes."""


@dataclasses.dataclass(frozen=True)
class Episode:
    """A row of the file."""

    task: str
    planner: str
    seed: int
    steps: int
    episode_return: float
    success: bool
    final_eval: float
    effective_samples: float
    plan_ms: float
    """Median planning time."""


@dataclasses.dataclass(frozen=True)
class Job:
    """Episodes of one planner on one task."""

    task: str
    planner: str
    seeds: tuple[int, ...]


def settings(options: Options, task: str, planner: str) -> dict[str, Any]:
    """The settings of a planner that differ from the task's."""
    words = dict(PLANNERS[planner])
    if words.pop("knots", False):
        horizon = task_config(find_task(task)).horizon
        words |= {"knots": max(1, round(horizon / options.knot_steps)), "spline": options.spline}
    return words


def run(options: Options, job: Job) -> list[Episode]:
    """The episodes of a job."""
    torch.set_num_threads(1)
    steps = options.steps or TASKS[job.task][0]
    env = lw.make(job.task, autoreset=False, horizon=steps, nthread=1)
    plan = lw.MPPI(job.task, nthread=1, **settings(options, job.task, job.planner))
    episodes = []
    for seed in job.seeds:
        done = lw.control(env, plan, seed=seed)
        episodes.append(Episode(
            job.task, job.planner, seed, done.steps, done.episode_return, done.succeeded, done.evals[-1].item(),
            done.plan_effective.nanmean().item(), 1e3 * done.plan_times.median().item(),
        ))  # fmt: skip
    return episodes


def jobs(options: Options, done: set[tuple[str, str, int]]) -> Iterator[Job]:
    """The jobs of all rounds, in order, without the episodes that are done."""
    for number in range(options.rounds):
        for task, planner in itertools.product(options.tasks, options.planners):
            count = TASKS[task][1]
            seeds = range(number * count, (number + 1) * count)
            if missing := tuple(seed for seed in seeds if (task, planner, seed) not in done):
                yield Job(task, planner, missing)


def checked(options: Options) -> Options:
    """The options, with "all" replaced.

    Raises:
        SystemExit: A task or a planner is unknown.
    """
    tasks = tuple(TASKS) if options.tasks == ("all",) else tuple(task for task in TASKS if task in options.tasks)
    for name, known in [(task, TASKS) for task in options.tasks] + [(name, PLANNERS) for name in options.planners]:
        if name not in known and name != "all":
            raise SystemExit(f"{name!r} is unknown: there are {', '.join(map(repr, known))}")
    return dataclasses.replace(options, tasks=tasks)


def main(options: Options) -> None:
    console = Console(highlight=False, width=140)
    options = checked(options)
    same = {name: getattr(options, name) for name in ("steps", "knot_steps", "spline")}
    episodes = read(options.out, same)
    waiting = jobs(options, {(e.task, e.planner, e.seed) for e in episodes})
    began = time.perf_counter()
    with concurrent.futures.ProcessPoolExecutor(options.processes, multiprocessing.get_context("spawn")) as pool:
        running: set[concurrent.futures.Future[list[Episode]]] = set()
        while True:
            while len(running) < options.processes and time.perf_counter() - began < options.stop_after:
                if (job := next(waiting, None)) is None:
                    break
                running.add(pool.submit(run, options, job))
            if not running:
                break
            finished, running = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in finished:
                found = future.result()
                episodes += found
                returns = " ".join(f"{e.episode_return:.1f}{'*' * e.success}" for e in found)
                console.print(f"{time.perf_counter() - began:5.0f} s  {found[0].task}, {found[0].planner}: {returns}")
                write(options, same, episodes)
    show(console, options, episodes)


def read(path: Path | None, same: dict[str, Any]) -> list[Episode]:
    """The episodes of a file that the same options made."""
    if path is None or not path.exists():
        return []
    content = json.loads(path.read_text())
    if content["options"] != same:
        raise SystemExit(f"{path} holds episodes of {content['options']}: give another --out")
    return [Episode(**row) for row in content["rows"]]


def write(options: Options, same: dict[str, Any], episodes: list[Episode]) -> None:
    if options.out is not None:
        used = {
            task: {planner: settings(options, task, planner) for planner in options.planners} for task in options.tasks
        }
        order = sorted(episodes, key=lambda e: (e.task, e.planner, e.seed))
        measurements.write(options.out, order, options=same, settings=used)


def show(console: Console, options: Options, episodes: list[Episode]) -> None:
    """A table for each task; the difference is that to the first planner on the same seeds, with its standard error."""
    for task in options.tasks:
        by_seed = {p: {e.seed: e for e in episodes if (e.task, e.planner) == (task, p)} for p in options.planners}
        seeds = sorted(set.intersection(*(set(rows) for rows in by_seed.values())))
        if not seeds:
            console.print(f"{task}: no seed is finished by every planner")
            continue
        config, steps = task_config(find_task(task)), options.steps or TASKS[task][0]
        title = f"{task}: {config.samples} samples of {config.horizon} steps, {len(seeds)} episodes of {steps} steps"
        table = Table("planner", "return", "to the first", "success", "evaluation", "samples, effective", "plan, ms")
        table.title = title
        first = by_seed[options.planners[0]]
        for planner, rows in by_seed.items():
            chosen = [rows[seed] for seed in seeds]
            returns = [e.episode_return for e in chosen]
            differences = [e.episode_return - first[e.seed].episode_return for e in chosen]
            good = sum(e.success for e in chosen)
            low, high = wilson(good, len(chosen))
            table.add_row(
                planner, f"{statistics.mean(returns):.1f} ({min(returns):.0f} to {max(returns):.0f})",
                f"{statistics.mean(differences):+.1f} ± {error(differences):.1f}",
                f"{good}/{len(chosen)} ({low:.0%} to {high:.0%})",
                f"{statistics.mean(e.final_eval for e in chosen):.3g}",
                f"{statistics.mean(e.effective_samples for e in chosen):.1f}",
                f"{statistics.median(e.plan_ms for e in chosen):.1f}",
            )  # fmt: skip
        console.print(table)


def error(values: list[float]) -> float:
    """Standard error of the mean."""
    return statistics.stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan


if __name__ == "__main__":
    main(tyro.cli(Options))
