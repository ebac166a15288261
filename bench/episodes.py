"""Episodes under MPPI, many of one task: how often they succeed, and how long they take.

python bench/episodes.py reach --episodes 100
python bench/episodes.py adroit_pen --episodes 100 --processes 2 --out pen.csv

Without further options these are the planning tasks of the Lyceum paper, with its settings and its 75 steps. Every
episode is a row of the table, written when it ends: the same command again continues where the last one stopped.
"""

import concurrent.futures
import csv
import dataclasses
import json
import math
import multiprocessing
import statistics
import time
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.console import Console

import lyceum_warp as lw
from lyceum_warp.cli.arguments import parameter
from lyceum_warp.controllers.control_statistics import wilson
from lyceum_warp.support.versions import versions


@dataclasses.dataclass(frozen=True)
class Options:
    """Success of MPPI over many episodes."""

    task: tyro.conf.Positional[str]
    """Task."""
    episodes: int = 100
    """Episodes; the seed of each is its number."""
    steps: int = 75
    """Steps of an episode."""
    processes: int = 1
    """Episodes at the same time; with more than one, each has one thread."""
    plan: tuple[str, ...] = ()
    """Other settings of MPPI than the task's own, as NAME=VALUE."""
    solver: tuple[str, ...] = ()
    """Other limits of the planner's constraint solver, as NAME=VALUE; the controlled world keeps its own."""
    param: tuple[str, ...] = ()
    """Parameters of the task, as NAME=VALUE."""
    stop_after: float = math.inf
    """Seconds after which no further episode starts."""
    out: Path | None = None
    """Table (CSV) of the episodes."""


@dataclasses.dataclass(frozen=True)
class Episode:
    """A row of the table."""

    episode: int
    success: bool
    episode_return: float
    eval_mean: float
    last_ten_evals: float
    """The evaluation metric's mean over the last ten steps."""
    length: int
    effective_samples: float
    failed_samples: float
    plan_ms: float
    """Median planning time."""
    seconds: float


_worlds: dict[Options, tuple[lw.Env, lw.MPPI]] = {}


def run(options: Options, number: int) -> Episode:
    """One episode, in worlds that a process makes once."""
    if options not in _worlds:
        nthread = None
        if options.processes > 1:
            torch.set_num_threads(1)
            nthread = 1
        params = dict(map(parameter, options.param))
        env = lw.make(options.task, autoreset=False, horizon=options.steps, nthread=1, **params)
        more: dict[str, Any] = dict(map(parameter, options.plan))
        if options.solver:
            more["solver"] = dict(map(parameter, options.solver))
        plan = lw.MPPI(options.task, nthread=nthread, **params, **more)
        _worlds[options] = env, plan
    env, plan = _worlds[options]
    summaries: list[dict[str, float]] = []
    done = lw.control(env, plan, seed=number, on_step=lambda _: summaries.append(plan.summary))
    return Episode(
        number, done.succeeded, done.episode_return, done.evals.mean().item(), done.evals[-10:].mean().item(),
        done.steps, statistics.mean(s["effective_samples"] for s in summaries),
        sum(s["failed_samples"] for s in summaries), 1e3 * done.plan_times.median().item(), done.wall_seconds,
    )  # fmt: skip


def main(options: Options) -> None:
    console = Console(highlight=False, width=140)
    same_experiment(options)
    rows = read(options.out)
    todo = [i for i in range(options.episodes) if i not in rows]
    began = time.perf_counter()
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.processes, context) as pool:
        waiting = list(reversed(todo))
        running: set[concurrent.futures.Future[Episode]] = set()
        while waiting or running:
            while waiting and len(running) < options.processes:
                if time.perf_counter() - began > options.stop_after:
                    waiting.clear()
                    break
                running.add(pool.submit(run, options, waiting.pop()))
            finished, running = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in finished:
                episode = future.result()
                rows[episode.episode] = episode
                write(options.out, episode)
                console.print(episode, soft_wrap=True)
    summarise(console, [rows[i] for i in sorted(rows)])
    console.print(versions("cpu"))


def summarise(console: Console, episodes: list[Episode]) -> None:
    n, good = len(episodes), sum(e.success for e in episodes)
    low, high = wilson(good, n)
    console.print(f"{good} of {n} episodes succeed: {good / n:.0%}, 95 % interval {low:.1%} to {high:.1%} (Wilson)")
    for name in ("episode_return", "eval_mean", "last_ten_evals", "effective_samples", "plan_ms", "seconds"):
        values = torch.tensor([getattr(e, name) for e in episodes])
        console.print(f"{name:<18} {values.mean():9.3f} ± {values.std(correction=0):.3f} "
                      f"({values.min():.3f} to {values.max():.3f})")  # fmt: skip


def same_experiment(options: Options) -> None:
    """Refuse to continue a table of other settings; its settings are in a file beside it."""
    if options.out is None:
        return
    settings = {name: getattr(options, name) for name in ("task", "steps", "plan", "solver", "param")}
    beside = options.out.with_suffix(".json")
    if options.out.exists():
        before = json.loads(beside.read_text()) if beside.exists() else {}
        before.pop("versions", None)
        if before != json.loads(json.dumps(settings)):
            raise SystemExit(f"{options.out} holds episodes of {before or 'unknown settings'}: give another --out")
    else:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(json.dumps(settings | {"versions": versions("cpu")}, indent=2) + "\n")


def read(path: Path | None) -> dict[int, Episode]:
    if path is None or not path.exists():
        return {}
    with path.open(newline="") as file:
        episodes = [parsed(row) for row in csv.DictReader(file)]
    return {episode.episode: episode for episode in episodes}


def parsed(row: dict[str, str]) -> Episode:
    kinds = {field.name: field.type for field in dataclasses.fields(Episode)}
    return Episode(**{k: v == "True" if kinds[k] is bool else kinds[k](v) for k, v in row.items()})  # type: ignore


def write(path: Path | None, episode: Episode) -> None:
    if path is None:
        return
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in dataclasses.fields(Episode)])
        if new:
            writer.writeheader()
        writer.writerow(dataclasses.asdict(episode))


if __name__ == "__main__":
    main(tyro.cli(Options))
