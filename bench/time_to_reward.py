"""Seconds until PPO or NPG first reaches given mean rewards.

python bench/time_to_reward.py go1_velocity --device cuda --nworld 4096 --targets 20 40 50 60 70 75 80 \\
    --seeds 42 43 44 --out bench/results/ppo-go1_velocity-h200.csv
python bench/time_to_reward.py go1_velocity --algorithm npg --npg.gamma 0.99 --npg.lam 0.95 ...

The mean reward is the mean return of the last 100 episodes that ended, as rsl_rl prints it, but without the worlds'
first episodes, which begin at a random step. The clock runs from the first rollout on. It counts captures of graphs,
sampling, updates and the statistics, but not the compilation of kernels, for which a learner with few worlds runs
before, nor the evaluations of the mean policy (--ppo.mean-every, --npg.mean-every), which are off unless asked for.
"""

import collections
import csv
import dataclasses
import gc
import statistics
import time
from pathlib import Path
from typing import Any, Literal

import measurements
import torch
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw
from lyceum_warp.runs.checkpoints import policy_content, write_content


@dataclasses.dataclass(frozen=True)
class Options:
    """Seconds to mean rewards."""

    task: tyro.conf.Positional[str]
    """Task: a name, or a file."""
    algorithm: Literal["ppo", "npg"] = "ppo"
    """Algorithm."""
    ppo: lw.PPOConfig = dataclasses.field(default_factory=lambda: lw.PPOConfig(mean_every=0))
    """Hyperparameters of PPO."""
    npg: lw.NPGConfig = dataclasses.field(default_factory=lambda: lw.NPGConfig(mean_every=0))
    """Hyperparameters of NPG."""
    targets: tuple[float, ...] = ()
    """Mean rewards; a run ends at the largest one."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds, one after another."""
    iterations: int = 1000
    """Iterations at most."""
    seconds: float | None = None
    """Seconds at most; no limit by default."""
    nworld: int = 4096
    """Worlds."""
    device: str = "cpu"
    """Device."""
    engine: str = "auto"
    """Engine."""
    threads: int = 1
    """Threads of torch on the CPU."""
    keep: Path | None = None
    """Folder for the policies at the end, which lw.load reads: SEED.pt."""
    out: Path | None = None
    """Table (CSV) of the iterations; a JSON file beside it has the results, the settings and the machine."""


@dataclasses.dataclass(frozen=True)
class Result:
    """One run."""

    seed: int
    reached: dict[str, tuple[float, int] | None]
    """For each target the seconds and the samples until it was first reached, or None."""
    iterations: int
    samples: int
    seconds: float
    sampling: float
    """Seconds of sampling."""
    update: float
    """Seconds of updates and statistics."""
    last: float
    """The mean reward at the end."""


KEPT = ("seed", "iteration", "samples", "seconds", "return_recent", "return_mean", "length_mean", "kl", "std_mean",
        "learning_rate", "value_loss", "entropy", "faults", "time_sample", "time_update", "mean_return")  # fmt: skip
"""Columns of the table."""


RECENT = 100
"""Episodes in the mean reward."""


def learner(options: Options, seed: int, nworld: int) -> lw.PPO | lw.NPG:
    env = lw.make(options.task, nworld=nworld, seed=seed, device=options.device, engine=options.engine)
    if options.algorithm == "npg":
        return lw.NPG(env, config=options.npg, seed=seed)
    return lw.PPO(env, config=options.ppo, seed=seed)


def run(options: Options, seed: int) -> tuple[Result, list[dict[str, Any]]]:
    """One run; returns its result and its iterations."""
    made = learner(options, seed, options.nworld)
    rows: list[dict[str, Any]] = []
    recent: collections.deque[float] = collections.deque(maxlen=RECENT)
    seconds = 0.0
    reached: dict[str, tuple[float, int] | None] = {f"{target:g}": None for target in options.targets}
    while len(rows) < options.iterations and (options.seconds is None or seconds < options.seconds):
        start = time.perf_counter()
        it = next(made)  # it ends with a copy to the host, so that the device has done its work
        seconds += time.perf_counter() - start - it.time_mean
        returns = made.rollout.episode_return[made.rollout.done]
        recent.extend(returns[~returns.isnan()][-RECENT:].tolist())
        mean = statistics.fmean(recent) if recent else float("nan")
        rows.append(it.row() | {"seed": seed, "seconds": seconds, "return_recent": mean})
        for target in options.targets:
            if mean >= target and reached[f"{target:g}"] is None:
                reached[f"{target:g}"] = seconds, it.samples
        if options.targets and all(reached.values()):
            break
    if options.keep is not None:
        path = options.keep / f"{seed}.pt"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_content(path, policy_content(made.iteration, made.policy, made.value))
    sampling = sum(row["time_sample"] for row in rows)
    last = rows[-1]["return_recent"]
    return Result(seed, reached, len(rows), made.samples, seconds, sampling, seconds - sampling, last), rows


def main(options: Options) -> None:
    torch.set_num_threads(options.threads)
    # kernels and libraries; at least as many worlds as fill the mini-batches
    next(learner(options, 0, max(2, options.ppo.minibatches)))
    console, results, rows = Console(width=130), [], []
    for seed in options.seeds:
        gc.collect()
        result, own = run(options, seed)
        results.append(result)
        rows += own
        console.print(
            f"seed {seed}: {result.last:.1f} after {result.seconds:.1f} s, {result.iterations} iterations and "
            f"{result.samples:,} samples; sampling {result.sampling:.1f} s, updates {result.update:.1f} s"
        )
    table = Table("mean reward", *(f"seed {seed}, s" for seed in options.seeds), "median, s", "million samples")
    for target in options.targets:
        found = [result.reached[f"{target:g}"] for result in results]
        whole = [entry for entry in found if entry is not None]
        median = f"{statistics.median(entry[0] for entry in whole):.1f}" if len(whole) == len(found) else ""
        samples = f"{statistics.median(entry[1] for entry in whole) / 1e6:.2f}" if len(whole) == len(found) else ""
        table.add_row(f"{target:g}", *("-" if e is None else f"{e[0]:.1f}" for e in found), median, samples)
    if options.targets:
        console.print(table)
    if options.out is not None:
        write(options, results, rows)


def write(options: Options, results: list[Result], rows: list[dict[str, Any]]) -> None:
    """The table, and beside it the results, the settings and what they ran on, as JSON."""
    assert options.out is not None
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("w", newline="") as file:
        names = [*KEPT, *(name for name in rows[0] if name.startswith("metrics/"))]
        writer = csv.DictWriter(file, names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    settings = {name: value for name, value in dataclasses.asdict(options).items() if name not in ("out", "keep")}
    measurements.write(options.out.with_suffix(".json"), results, options.device, options=settings)


if __name__ == "__main__":
    main(tyro.cli(Options))
