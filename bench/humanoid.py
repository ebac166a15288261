"""Measure how well MPPI makes humanoids stand, walk and get up in real time, despite pushes.

    lyceum-warp bench humanoid
    lyceum-warp bench humanoid --tasks humanoid_stand --contestants real_time --repeats 20

An episode lasts 20 s. In the contestant ``real_time``, the plant never waits, and the planner plans as often as it can
(``lw.control_async``). ``predicted`` is the same with plans from predicted states (``predict=True``), ``discrete`` with
the physics "discrete" instead of the task's preset. In ``in_turn`` and ``discrete_in_turn``, the plant waits until each
plan is ready. Run the real-time episodes on idle cores, because other processes delay plans.
"""

import dataclasses
import functools
import math
import sys
from collections.abc import Sequence
from typing import Any

import experiment
import torch
from experiment import Row, Table, choose, median_and_range

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.controllers.report import wilson
from lyceum_warp.support.machine import cpu_cores

SECONDS = 20.0
STARTS = dict(start_noise=0.02)  # uniform noise of every joint, in rad and rad/s
# times in s, and impulses in N s with uniformly drawn directions
PUSHES = dict(push_times=[5.0, 10.0, 15.0], push_impulse=[10.0, 20.0])
TASKS = {
    "humanoid_stand": PUSHES, "humanoid_walk": PUSHES, "humanoid_get_up": dict(push_times=[15.0]), "g1_stand": PUSHES,
    "g1_walk": PUSHES,
}  # fmt: skip
"""Parameters of the plant, in addition to ``STARTS``."""
FIRST_SEED = 1000
"""Seed of the first episode. It determines the initial state, the pushes and the planner's noise."""
WALKS, UP = {"humanoid_walk": 0.5, "g1_walk": 0.3}, 1.1
"""Minimum mean speed of a walk, m/s, and minimum height of the humanoid's standing torso, m."""
CONTESTANTS = {
    "real_time": "in real time", "predicted": "in real time, from predicted states", "in_turn": "the plant waits",
    "discrete": "in real time", "discrete_in_turn": "the plant waits",
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    contestant: str
    seed: int
    seconds: float
    threads: int
    settings: str
    """Planner settings that differ from the defaults."""


@functools.cache
def planner(task: str, threads: int, options: tuple[tuple[str, Any], ...]) -> lw.MPPI:
    return lw.MPPI(task, nthread=threads, **dict(options))


def options_of(contestant: str) -> dict[str, Any]:
    return {"physics": "discrete"} if contestant.startswith("discrete") else {}


def settings(task: str, contestant: str) -> str:
    planning = find_task(task).planning
    both = {**planning.settings, **planning.options, **options_of(contestant)}
    return ", ".join(f"{name} {value}" for name, value in both.items())


def cases(options: experiment.Options) -> list[Case]:
    """List the episodes; contestants take turns."""
    tasks = choose(options.tasks, TASKS, ("humanoid_stand",) if options.short else (), what="task")
    contestants = choose(options.contestants, CONTESTANTS, what="contestant")
    repeats = options.repeats or (1 if options.short else 20)
    seconds = 0.3 if options.short else SECONDS
    return [
        Case(task, name, FIRST_SEED + repeat, seconds, options.threads or cpu_cores(), settings(task, name))
        for task in tasks for repeat in range(repeats) for name in contestants
    ]  # fmt: skip


def estimate(case: Case) -> float:
    return 1.1 * case.seconds


@torch.no_grad()
def measure(case: Case, options: experiment.Options) -> dict[str, Any]:
    """Run an episode."""
    params = STARTS | TASKS[case.task]
    with experiment.cores(case.threads):
        plant = lw.make(case.task, autoreset=False, nthread=1, **params)
        episode: dict[str, Any] = dict(steps=round(case.seconds / plant.timestep), seed=case.seed)
        plans = planner(case.task, case.threads, tuple(options_of(case.contestant).items()))
        if case.contestant.endswith("in_turn"):
            trajectory = lw.control(plant, plans, **episode)
        else:
            trajectory = lw.control_async(plant, plans, predict=case.contestant == "predicted", **episode)
    report = lw.control_report([trajectory])
    positions = trajectory.states[:, slice(*trajectory.state_parts["qpos"])]
    up, seconds = positions[:, 2] > UP, trajectory.steps * trajectory.timestep
    return {
        "seconds": seconds, "fell": bool(plant.terminated), "return": trajectory.episode_return,
        "speed": ((positions[-1, 0] - positions[0, 0]) / seconds).item(),
        "up_share": up.float().mean().item(), "up_at_the_end": bool(up[-round(0.05 * len(up)) :].all()),
        "plans": report.plans, "misses": report.misses, "plan_ms": report.plan_p50_ms,
        "plan_max_ms": report.plan_max_ms, "oldest_action_steps": int(trajectory.age_steps.max()),
    }  # fmt: skip


def share(good: int, count: int) -> str:
    low, high = wilson(good, count)
    return f"{good} of {count} ({low:.0%} to {high:.0%})"


def success(task: str, one: dict[str, Any]) -> bool:
    if task == "humanoid_get_up":
        return bool(one["up_at_the_end"])
    return not one["fell"] and one["speed"] >= WALKS.get(task, -math.inf)


def tables(rows: Sequence[Row]) -> list[Table]:
    groups = experiment.grouped(rows, "task", "contestant", "threads", "settings")
    lines = []
    for (task, name, threads, settings_of_plans), same in groups.items():
        episodes = [row.result for row in same]
        plans = sum(one["plans"] for one in episodes)
        misses = sum(one["misses"] for one in episodes)
        lines.append([
            task, CONTESTANTS[name], str(threads), settings_of_plans,
            share(sum(success(task, one) for one in episodes), len(episodes)),
            median_and_range([one["seconds"] for one in episodes], ".1f"),
            median_and_range([one["speed"] for one in episodes]), f"{1 - misses / max(plans, 1):.2%}",
            median_and_range([one["plan_ms"] for one in episodes if one["plan_ms"]], ".1f"),
            f"{max(one['plan_max_ms'] or 0.0 for one in episodes):.1f}",
            str(max(one["oldest_action_steps"] for one in episodes)),
        ])  # fmt: skip
    walks = ", ".join(f"{speed} m/s ({task})" for task, speed in WALKS.items())
    title = (
        f"Episodes of {SECONDS:g} s. Success: stands through; walks at {walks} or more, without a fall; has got up "
        f"(torso above {UP} m in the last second). Deadlines: plans within a step, 15 ms (humanoid) and 20 ms (G1). "
        "Age: steps from the state of a plan to its last action that was applied."
    )
    header = [
        "task", "planner", "threads", "settings", "success (95 % interval)", "seconds before a fall", "speed, m/s",
        "deadlines met", "plan, ms", "longest, ms", "age",
    ]  # fmt: skip
    return [Table(title, header, lines)]


EXPERIMENT = experiment.Experiment(
    name="humanoid",
    conditions="Plants and planners run on the C engine: plants with exact physics, planners with fast physics.",
    summary="Humanoids planned in real time: standing, walking, getting up.",
    cases=cases, estimate=estimate, measure=measure, tables=tables,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
