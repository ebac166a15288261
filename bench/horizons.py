"""The effect of a value function on short horizons (Lowrey et al. 2019, POLO): MPPI with and without one.

    lyceum-warp train hopper --nworld 10 --out runs/hopper
    python bench/horizons.py runs/hopper --horizons 4 8 16 32 64

The value function is the one that NPG fitted while it trained the run's policy, unchanged; the policy itself is not
used. The discount is the one that it was fitted for, with and without it.
"""

import concurrent.futures
import csv
import dataclasses
import itertools
import multiprocessing
import statistics
import time
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw
from lyceum_warp.runs.folder import Run


@dataclasses.dataclass(frozen=True)
class Options:
    """Returns by horizon, with and without a terminal value."""

    run: tyro.conf.Positional[Path]
    """Folder of an NPG run."""
    horizons: tuple[int, ...] = (4, 8, 16, 32, 64)
    """Horizons."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the initial states and of the noise."""
    steps: int = 400
    """Steps of an episode."""
    samples: int = 32
    """Samples of a plan."""
    temperatures: tuple[float, ...] = (0.1, 1.0)
    """Temperatures: values differ more than the rewards of a few steps do."""
    noise: float = 0.5
    """Standard deviation of the noise."""
    processes: int = 1
    """Episodes at the same time; with more than one, each has one thread."""
    out: Path | None = None
    """Table (CSV) of the episodes."""


@dataclasses.dataclass(frozen=True)
class Episode:
    """A row of the table."""

    horizon: int
    value: bool
    temperature: float
    seed: int
    episode_return: float
    length: int
    final_eval: float
    plan_ms: float


def episode(options: Options, horizon: int, with_value: bool, temperature: float, seed: int) -> Episode:
    nthread = None
    if options.processes > 1:
        torch.set_num_threads(1)
        nthread = 1
    config = Run.open(options.run).config
    task, params, physics = config["task"], config["params"], config.get("physics", {})
    env = lw.make(task, autoreset=False, horizon=options.steps, nthread=1, **(physics | params))
    # the rewards of the task itself, with and without the value function that was fitted to them
    own = {name: env.task.params[name] for name in env.task.task.planning.params}
    more: dict[str, Any] = {"value": lw.load_value(options.run)} if with_value else {}
    plan = lw.MPPI(
        task, horizon=horizon, samples=options.samples, noise=options.noise, discount=config["npg"]["gamma"], seed=seed,
        temperature=temperature, nthread=nthread, **more, **(own | params),
    )  # fmt: skip
    env.rand_reset(seed)
    total, times = 0.0, []
    while not env.done.item():
        start = time.perf_counter()
        action = plan(env.get_state())
        times.append(time.perf_counter() - start)
        env.step(action[None])
        total += env.reward.item()
    length = int(env.episode_step.item())
    return Episode(
        horizon, with_value, temperature, seed, total, length, env.eval.item(), 1e3 * statistics.median(times)
    )


def main(options: Options) -> None:
    kinds = list(itertools.product(sorted(options.horizons), (False, True), options.temperatures))
    cases = [(*kind, seed) for kind in reversed(kinds) for seed in options.seeds]  # the longest first
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.processes, context) as pool:
        episodes = list(pool.map(episode, [options] * len(cases), *zip(*cases, strict=True)))
    table = Table("horizon", "value function", "temperature", "return", f"steps of {options.steps}", "plan, ms")
    for column in table.columns[3:]:
        column.justify = "right"
    for horizon, with_value, temperature in kinds:
        rows = [e for e in episodes if (e.horizon, e.value, e.temperature) == (horizon, with_value, temperature)]
        returns = [e.episode_return for e in rows]
        table.add_row(
            str(horizon), "yes" if with_value else "no", f"{temperature:g}",
            f"{statistics.mean(returns):.0f} ({min(returns):.0f} to {max(returns):.0f})",
            f"{statistics.mean(e.length for e in rows):.0f}", f"{statistics.median(e.plan_ms for e in rows):.1f}",
        )  # fmt: skip
    Console().print(table)
    if options.out is not None:
        with options.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, [field.name for field in dataclasses.fields(Episode)])
            writer.writeheader()
            writer.writerows(map(dataclasses.asdict, episodes))


if __name__ == "__main__":
    main(tyro.cli(Options))
