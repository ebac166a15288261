"""Measure the time until NPG or PPO reaches a target return.

    lyceum-warp bench learning --device cuda
    lyceum-warp bench learning --tasks go1_velocity --algorithm npg --device cuda

The time includes graph captures, sampling and updates. It excludes kernel compilation and evaluations. The mean return
is that of the last 100 episodes, or of 16 separate episodes if iterations are short. On go1_velocity, even a robot that
stands still reaches high returns. The program therefore also measures tracking errors and falls.
"""

import collections
import csv
import dataclasses
import math
import statistics
import sys
import time
from collections.abc import Sequence
from typing import Any, Literal

import experiment
import torch
from experiment import Experiment, Row, Table, choose

import lyceum_warp as lw
from lyceum_warp.env import moved
from lyceum_warp.viz import STYLES, finish_axes, new_figure

TARGETS: dict[str, tuple[str, float, int, int | None, int]] = {
    "go1_velocity": ("ppo", 80.0, 4096, None, 0),
    "hopper": ("npg", 1500.0, 4096, 65_536, 5),
    "half_cheetah": ("npg", 5000.0, 4096, 65_536, 5),
    "humanoid": ("npg", 4500.0, 8192, 131_072, 5),
}
"""By task: algorithm, target return, worlds, samples per iteration, and iterations between evaluations (0: none)."""

JUDGED, RECENT, WALKED = 16, 100, (256, 500)
"""Number of episodes in an evaluation, number of episodes in a mean return, and (worlds, steps) of the walking test."""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    algorithm: Literal["npg", "ppo"] | None = None
    """Algorithm; by default, the one listed in TARGETS for the task."""
    seconds: float = 300.0
    """Maximum duration of a run in seconds."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    algorithm: str
    seed: int
    nworld: int
    target: float
    seconds: float
    device: str


def cases(options: Options) -> list[Case]:
    tasks = choose(options.tasks, TARGETS, ("hopper",) if options.short else (), what="task")
    return [
        Case(task, options.algorithm or TARGETS[task][0], seed, 8 if options.short else TARGETS[task][2],
             TARGETS[task][1], 1.0 if options.short else options.seconds, options.device)
        for task in tasks for seed in options.seeds or range(1 if options.short else 3)
    ]  # fmt: skip


def learner(case: Case, nworld: int, **changes: Any) -> Any:
    env = lw.make(case.task, nworld=nworld, seed=case.seed, device=case.device)
    if case.algorithm == "ppo":
        return lw.PPO(env, config=lw.PPOConfig(**changes), seed=case.seed)
    return lw.NPG(env, config=lw.NPGConfig(**changes), seed=case.seed)


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    _, _, _, per_iteration, judge_every = TARGETS[case.task]
    short = case.nworld < 64
    changes: dict[str, Any] = {"mean_every": 0}
    if case.algorithm == "npg":
        changes["samples"] = 64 if short else per_iteration
    next(learner(case, 4, **(changes | ({"samples": 64} if case.algorithm == "npg" else {}))))  # compiles kernels
    learning = learner(case, case.nworld, **changes)
    judge = Judge(learning.env) if judge_every else None
    recent: collections.deque[float] = collections.deque(maxlen=RECENT)
    seconds, curve, mean = 0.0, [], -math.inf
    while seconds < case.seconds and mean < case.target:
        began = time.perf_counter()
        it = next(learning)  # an iteration ends with a copy to the host, which waits for the device
        seconds += time.perf_counter() - began
        if judge is None:
            returns = learning.rollout.episode_return[learning.rollout.done]
            recent.extend(returns[~returns.isnan()][-RECENT:].tolist())
            mean = statistics.fmean(recent) if recent else -math.inf
        elif it.iteration % judge_every == 0:
            mean = judge(learning.policy)
        else:
            continue
        if math.isfinite(mean):
            curve.append([it.samples, round(seconds, 4), round(mean, 3)])
    walked = walk(case, learning.policy) if case.task == "go1_velocity" else {}
    return {"reached": mean >= case.target, "seconds": seconds, "samples": learning.samples, "curve": curve, **walked}


@torch.no_grad()
def walk(case: Case, policy: lw.GaussianPolicy) -> dict[str, float]:
    nworld, steps = WALKED
    env = lw.make(case.task, nworld=min(nworld, case.nworld), seed=1000, device=case.device)
    sums = torch.zeros(3, dtype=torch.float64, device=env.obs.device)
    for _ in range(steps):
        env.step(policy(env.obs))
        errors = (env.metrics["velocity_error"], env.metrics["yaw_rate_error"], env.terminated)
        sums += torch.stack([error.double().mean() for error in errors])
    velocity, yaw_rate, falls = (sums / steps).tolist()
    return {"velocity_error": velocity, "yaw_rate_error": yaw_rate, "falls_per_world_second": falls / env.timestep}


class Judge:
    """Evaluate a stochastic policy, always with the same initial states and noise."""

    def __init__(self, env: lw.Env) -> None:
        self.env = env.replicate_few(JUDGED)

    def __call__(self, policy: lw.GaussianPolicy) -> float:
        policy, out = moved(policy, self.env), torch.empty_like(self.env.action)

        def noisy(obs: torch.Tensor) -> torch.Tensor:
            return policy.sample(obs, torch.randn(out.shape, device=out.device), out)

        with torch.random.fork_rng([out.device] if out.is_cuda else []):
            torch.manual_seed(0)
            return lw.evaluate(self.env, noisy, self.env.nworld, seed=0).returns.mean().item()


# tables and figure


WALK = {"velocity_error": "velocity error, m/s", "yaw_rate_error": "yaw rate error, rad/s",
        "falls_per_world_second": "falls a world-second"}  # fmt: skip


def tables(rows: Sequence[Row]) -> list[Table]:
    lines, tasks = [], list(TARGETS)
    walk = {name: title for name, title in WALK.items() if any(name in row.result for row in rows)}
    for row in sorted(rows, key=lambda row: tasks.index(row.case["task"])):
        case, result = row.case, row.result
        reached = f"{result['seconds']:.1f}" if result["reached"] else f"not in {result['seconds']:.0f}"
        lines.append([
            case["task"], case["algorithm"].upper(), f"{case['nworld']:,}", f"{case['target']:,g}",
            str(case["seed"]), reached, f"{result['samples'] / 1e6:.1f}",
            *(f"{result[name]:.3g}" if name in result else "" for name in walk),
        ])  # fmt: skip
    header = ["task", "algorithm", "worlds", "target", "seed", "seconds", "million samples", *walk.values()]
    return [Table("Seconds of sampling and learning until the mean return reaches a target.", header, lines)]


def figure(rows: Sequence[Row]) -> Any:
    runs = [row for row in rows if (row.case["task"], row.case["algorithm"]) == ("go1_velocity", "ppo")]
    if not runs:
        return None
    figure = new_figure("learning", 6.5, 3.9)
    axes = figure.subplots()
    color, marker, line = STYLES[0]
    gpu = runs[0].provenance.get("gpu")
    ours = f"lyceum_warp on {f'an {gpu.split()[1]}' if gpu else 'CPU cores'}"
    for k, row in enumerate(runs):
        _, seconds, returns = zip(*row.result["curve"], strict=True)
        axes.plot(seconds, returns, color=color, linestyle=line, marker=marker, markevery=0.15, markersize=4,
                  linewidth=1.3, label=ours if k == 0 else None)  # fmt: skip
    with (experiment.RESULTS / "other-projects.csv").open(newline="") as file:
        curve = [row for row in csv.DictReader(file) if row["project"] == "mjlab" and row["threshold"]]
    points = [(float(row["value"]), float(row["threshold"])) for row in curve]
    color, marker, line = STYLES[1]
    label = f"mjlab {curve[0]['version']} on an {curve[0]['machine'].split(' (')[0].removeprefix('NVIDIA ')}"
    axes.plot(*zip(*points, strict=True), color=color, linestyle=line, marker=marker, label=label)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("seconds of sampling and learning")
    axes.set_ylabel("mean return of the last 100 episodes")
    axes.set_title("go1_velocity, 4,096 worlds", loc="left", fontsize="medium")
    axes.legend(frameon=False, loc="lower right")
    finish_axes([axes])
    return figure


EXPERIMENT = Experiment(
    name="learning", conditions="The Warp engine on a GPU, the C engine on a CPU, both with exact physics.",
    summary="Seconds of learning until NPG or PPO reaches a target return.",
    cases=cases, estimate=lambda case: 0.3 * case.seconds, measure=measure, tables=tables, figure=figure,
    options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
