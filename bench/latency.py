"""Measure planning in real time: planning times, missed deadlines, rewards, and ages of actions.

    lyceum-warp bench latency
    lyceum-warp bench latency --tasks reach humanoid --samples 256 1024 --horizons 32 --device cuda
    lyceum-warp bench latency --tasks dm/cartpole_swingup --own --seconds 50

Episodes run in real time (``lw.control_async``) until their total duration reaches ``--seconds``. A plan meets its
deadline if it takes no longer than one step of the plant. Run the benchmark on idle cores, because other processes
delay plans.
"""

import dataclasses
import sys
from collections.abc import Sequence
from typing import Any

import experiment
import torch
from experiment import Row, Table, choose, installed, median_and_range

import lyceum_warp as lw
from lyceum_warp.algos import task_config
from lyceum_warp.binding import find_task
from lyceum_warp.core import EnvOptions
from lyceum_warp.support.machine import cpu_cores

COST = {
    ("point_mass", "own"): 2.0, ("reach", "own"): 6.0, ("cartpole_swingup", "own"): 2.0, ("half_cheetah", "own"): 15.0,
    ("humanoid", "fast"): 9.0, ("humanoid", "exact"): 120.0, ("adroit_pen", "own"): 95.0,
}  # fmt: skip
"""Microseconds on two cores for one step of one sample, by task and by the planner's physics."""
LONGEST = 0.2
"""Maximum seconds per plan, unless samples or horizons are given."""
SAMPLES, HORIZONS = (16, 64, 256, 1024), (16, 32, 64)
CONTESTANTS = {"mujoco": "C engine", "warp": "Warp engine"}


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    samples: tuple[int, ...] = ()
    """Numbers of samples; by default 16, 64, 256 and 1024."""
    horizons: tuple[int, ...] = ()
    """Horizons of plans, in steps; by default 16, 32 and 64."""
    own: bool = False
    """Whether to use each task's suggested horizon and number of samples."""
    physics: tuple[str, ...] = ()
    """Names of the planner's physics: "exact", or a name that the task defines. The default is the exact physics and
    the physics that the task suggests for planning. If the suggested physics has no name, the exact physics is
    omitted."""
    seconds: float = 10.0
    """Seconds per case. The 99.9 % quantile needs a thousand plans."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    physics: str
    """Name of the planner's physics; "own" if the task suggests options that have no name."""
    samples: int
    horizon: int
    contestant: str
    device: str
    threads: int
    seconds: float
    repeat: int


def cases(options: Options) -> list[Case]:
    short, cuda = options.short, options.device.startswith("cuda")
    tasks = options.tasks or (("point_mass",) if short else tuple(dict.fromkeys(task for task, _ in COST)))
    contestants = choose(options.contestants, CONTESTANTS, ("warp",) if cuda else ("mujoco",), what="contestant")
    samples = options.samples or (SAMPLES[:1] if short else SAMPLES)
    horizons = options.horizons or (HORIZONS[:1] if short else HORIZONS)
    sizes = {task: [(number, horizon) for horizon in horizons for number in samples] for task in tasks}
    unlimited = bool(options.samples or options.horizons or cuda)
    if options.own:
        if options.samples or options.horizons:
            raise ValueError("--own takes the samples and the horizon of each task: omit --samples and --horizons")
        configs, unlimited = {task: task_config(find_task(task)) for task in tasks}, True
        sizes = {task: [(config.samples, config.horizon)] for task, config in configs.items()}
    seconds, threads = 1.0 if short else options.seconds, options.threads or cpu_cores()
    devices = {"mujoco": "cpu", "warp": options.device}
    return [
        Case(task, physics, number, horizon, name, devices[name], threads, seconds, repeat)
        for repeat in range(options.repeats or 1) for task in tasks for physics in physics_of(task, options.physics)
        for number, horizon in sizes[task] for name in contestants
        if unlimited or expected(task, physics, number, horizon) < LONGEST
    ]  # fmt: skip


def physics_of(task: str, names: Sequence[str]) -> Sequence[str]:
    definition = find_task(task)
    if names:
        return [name for name in names if name == "exact" or name in definition.physics]
    suggested = EnvOptions().changed(definition.planning.options).physics.base
    return ["own"] if suggested is None else list(dict.fromkeys((suggested, "exact")))


def expected(task: str, physics: str, samples: int, horizon: int) -> float:
    return 1e-6 * COST.get((task, physics), 20.0) * samples * horizon


def estimate(case: Case) -> float:
    if case.device != "cpu":
        return case.seconds + 5.0
    return case.seconds + 1.0 + 4.0 * expected(case.task, case.physics, case.samples, case.horizon)


@torch.no_grad()
def measure(case: Case, options: Options) -> dict[str, Any]:
    if case.task.startswith("adroit"):
        installed("gymnasium_robotics", "gymnasium-robotics")
    torch.set_num_threads(1)
    with experiment.cores(case.threads):
        plant = lw.make(case.task, autoreset=False, nthread=1)
        placement: dict[str, Any] = {} if case.physics == "own" else {"physics": case.physics}
        if case.contestant == "mujoco":
            placement["nthread"] = case.threads
        planner = lw.MPPI(
            case.task, samples=case.samples, horizon=case.horizon, engine=case.contestant, device=case.device,
            **placement,
        )  # fmt: skip
        done: list[lw.Trajectory] = []
        steps = round(case.seconds / plant.timestep)
        while (left := steps - sum(episode.steps for episode in done)) > 0:
            done.append(lw.control_async(plant, planner, steps=left, seed=1000 * case.repeat + len(done)))
    report = lw.control_report(done)
    return {
        "deadline_ms": report.deadline_ms, "plans": report.plans, "plan_ms": report.plan_p50_ms,
        "p99_ms": report.plan_p99_ms, "p99_9_ms": report.plan_p99_9_ms, "max_ms": report.plan_max_ms,
        "met": None if report.miss_share is None else 1.0 - report.miss_share, "age_steps": report.age_steps_mean,
        "age_steps_max": report.age_steps_max, "age_ms": report.age_mean_ms, "late_steps": report.late_ticks,
        "reward_per_second": sum(episode.episode_return for episode in done) / (report.steps * plant.timestep),
        "episodes": len(done), "terminated": sum(episode.terminated for episode in done),
        "returns": [episode.episode_return for episode in done], "settings": report.controller,
    }  # fmt: skip


def tables(rows: Sequence[Row]) -> list[Table]:
    lines_of: dict[str, list[list[str]]] = {}
    deadlines = {row.case["task"]: row.result["deadline_ms"] for row in rows}
    order = ("physics", "contestant", "device", "horizon", "samples", "repeat")
    for row in sorted(rows, key=lambda row: [row.case[name] for name in order]):
        case, result = row.case, row.result
        lines_of.setdefault(case["task"], []).append([
            case["physics"], f"{case['samples']} x {case['horizon']}",
            f"{CONTESTANTS[case['contestant']]}, {case['device']}", number(result["plan_ms"], ".3g"),
            number(result["p99_9_ms"], ".3g") or f"{number(result['max_ms'], '.3g')} (longest)",
            number(result["met"], ".1%"), f"{result['age_steps']:.2f} (at most {result['age_steps_max']})",
            f"{result['age_ms']:.0f}", f"{result['reward_per_second']:.4g}",
            f"{result['terminated']} of {result['episodes']}", median_and_range(result.get("returns", ()), ".4g"),
        ])  # fmt: skip
    header = ["physics", "samples x horizon", "engine", "plan, ms", "99.9 %, ms", "deadlines met", "age, steps",
              "age, ms", "reward a second", "ended early", "returns"]  # fmt: skip
    return [
        Table(f"{task}, a step every {deadlines[task]:.3g} ms. Plan: median time; below a thousand plans, the longest "
              "time stands for the 99.9 % quantile. Age of actions: mean and maximum.", header, lines)
        for task, lines in lines_of.items()
    ]  # fmt: skip


def number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


EXPERIMENT = experiment.Experiment(
    name="latency",
    conditions="Plants run on the C engine with exact physics; tables name the planner's engine and physics.",
    summary="Planning in real time: planning time, deadlines met, age of actions and rewards.",
    cases=cases, estimate=estimate, measure=measure, tables=tables, options=Options, packages=("gymnasium-robotics",),
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
