"""Learning curves of NPG over several seeds, each in a process of its own.

python bench/learning.py hopper --seeds 0 1 2 --iterations 100 --out hopper.csv
python bench/curves.py hopper=hopper.csv --out hopper.png
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

import measurements
import torch
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw
from lyceum_warp.algos.networks import moved
from lyceum_warp.cli.arguments import parameter


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
    param: tuple[str, ...] = ()
    """Parameters of the task, each as NAME=VALUE."""
    target: float | None = None
    """A mean return at which a run ends: that of the policy with its noise over 16 episodes of its own, off the clock.
    An iteration's episodes would not do: with short segments, the long ones among them end late."""
    judge_every: int = 5
    """Iterations from one such judgement to the next."""
    reward_scale: float = 1.0
    """Factor of all rewards that NPG gets. The returns in the table are the task's own."""
    outlier: float | None = None
    """A reward that one sample of iteration 3 gets in place of its own."""
    processes: int = 1
    """Runs at the same time; each then has one thread."""
    out: Path | None = None
    """Table (CSV) of the iterations."""


def run(options: Options, seed: int) -> list[dict[str, Any]]:
    """One run; returns its iterations and adds the seconds since its start."""
    nthread = None
    if options.processes > 1:
        torch.set_num_threads(1)
        nthread = 1 if options.device == "cpu" else None
    env = lw.make(
        options.task, nworld=options.nworld, seed=seed, device=options.device, engine=options.engine,
        integrator=options.integrator, nthread=nthread, **dict(map(parameter, options.param)),
    )  # fmt: skip
    npg = lw.NPG(env, config=options.config, seed=seed)
    if options.reward_scale != 1.0 or options.outlier is not None:
        distort(npg, options)
    judge = None if options.target is None else Judge(env)
    seconds, rows = 0.0, []
    for number in range(1, options.iterations + 1):
        start = time.perf_counter()
        iteration = next(npg)
        seconds += time.perf_counter() - start
        row = iteration.row() | {"seed": seed, "seconds": seconds, "judged": None}
        rows.append(row)
        if judge is not None and options.target is not None and number % options.judge_every == 0:
            row["judged"] = judge(npg.policy)
            if row["judged"] >= options.target:
                break
    return rows


def distort(npg: lw.NPG, options: Options) -> None:
    """Scale the rewards of the rollouts, and put an outlier into the middle of the third."""
    collect, reward = npg.rollout.collect, npg.rollout.reward

    def distorted(policy: lw.GaussianPolicy, noise: torch.Tensor) -> None:
        collect(policy, noise)
        reward.mul_(options.reward_scale)
        if options.outlier is not None and npg.iteration == 2:
            reward[len(reward) // 2, 0] = options.outlier

    npg.rollout.collect = distorted  # type: ignore[method-assign]


class Judge:
    """Evaluates a policy with its noise, in worlds of its own."""

    def __init__(self, env: lw.Env) -> None:
        self.env = env.replicate_few(16)

    def __call__(self, policy: lw.GaussianPolicy) -> float:
        """Mean return; the same initial states and the same noise each time."""
        policy, out = moved(policy, self.env), torch.empty_like(self.env.action)
        generator = torch.Generator(out.device).manual_seed(0)

        def noisy(obs: torch.Tensor) -> torch.Tensor:
            return policy.sample(obs, torch.randn(out.shape, generator=generator, device=out.device), out)

        return lw.evaluate(self.env, noisy, self.env.nworld, seed=0).returns.mean().item()


def main(options: Options) -> None:
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.processes, mp_context=context) as pool:
        runs = list(pool.map(run, [options] * len(options.seeds), options.seeds))
    table = Table("iteration", "samples", "return", "min .. max over seeds", "mean policy", "min .. max over seeds")
    for i in range(options.iterations):
        if (i + 1) % max(1, options.iterations // 10) and i > 0:
            continue
        rows = [rows[i] for rows in runs if i < len(rows)]
        if not rows:
            break
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
            last, reached = rows[-1], (rows[-1]["judged"] or -math.inf) >= options.target
            spent = f"{last['seconds']:.1f} s and {last['samples']:,} samples"
            console.print(f"a mean return of {options.target:g}, seed {seed}: {'' if reached else 'not '}after {spent}")
    if options.out is not None:
        write(options, [row for rows in runs for row in rows])


KEPT = ("seed", "iteration", "samples", "seconds", "return_mean", "length_mean", "mean_return", "judged",
        "terminal_reward", "time_mean")  # fmt: skip
"""Columns of the table; "seconds" counts those of the mean policy's evaluations, "time_mean", but not the judge's."""


def write(options: Options, rows: list[dict[str, Any]]) -> None:
    """The table, and beside it the settings and what they ran on, as JSON."""
    assert options.out is not None
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, KEPT, extrasaction="ignore")
        writer.writeheader()
        writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    settings = {name: value for name, value in dataclasses.asdict(options).items() if name != "out"}
    content = {"options": settings, "versions": measurements.context(options.device)}
    options.out.with_suffix(".json").write_text(json.dumps(content, indent=1) + "\n")


def spread(rows: list[dict[str, Any]], key: str) -> tuple[str, str]:
    values = [row[key] for row in rows if row[key] is not None and not math.isnan(row[key])]
    if not values:
        return "", ""
    return f"{statistics.mean(values):.0f}", f"{min(values):.0f} .. {max(values):.0f}"


if __name__ == "__main__":
    main(tyro.cli(Options))
