"""Compare MPPI with a Python planner: episode results and planning time (the paper's table).

    lyceum-warp bench mppi --threads 16
    lyceum-warp bench mppi --parts episodes --threads 1 --jobs 16

The part ``episodes`` measures success and time of episodes of 75 steps, with the paper's settings. The part ``plans``
measures planning times from given states. All planners control the same plant. Each planner runs a block of episodes,
and then the next planner runs the same block. In the contestants ``mppi_together`` and ``mppi_warp_together``, one
planner controls the plants of all episodes at once. The contestant ``mppi_fast`` plans with the task's "fast" physics,
and its plant has the exact physics.
"""

import dataclasses
import functools
import itertools
import os
import statistics
import sys
import time
from collections.abc import Sequence
from typing import Any

import experiment
import python_mppi
import torch
from experiment import Row, Table, choose, installed, median_and_range

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.controllers.report import wilson

EPISODES = {"reach": 75, "adroit_pen": 75, "herb_reach": 150, "panda_lift": 150, "aloha_lift": 150,
            "arm_hand_pickup": 300}  # fmt: skip
PAPER = ("reach", "adroit_pen")
PLANS = ("reach", "half_cheetah", "adroit_pen")
TASKS = ("reach", "half_cheetah", "adroit_pen", "herb_reach", "panda_lift", "aloha_lift", "arm_hand_pickup")

CONTESTANTS = {
    "mppi": "lyceum_warp, C engine",
    "mppi_fast": "lyceum_warp, C engine, fast physics",
    "mppi_warp": "lyceum_warp, Warp engine",
    "mppi_together": "lyceum_warp, C engine, a set at a time",
    "mppi_warp_together": "lyceum_warp, Warp engine, a set at a time",
    "python": "Python, a message a plan",
}
OURS, TOGETHER = ("mppi", "mppi_fast", "mppi_warp"), ("mppi_together", "mppi_warp_together")
ON_WARP = ("mppi_warp", "mppi_warp_together")


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    parts: tuple[str, ...] = ()
    """Parts: plans, episodes; by default both."""
    episodes: int = 100
    """Number of episodes per set of seeds."""
    sets: tuple[int, ...] = (1, 2, 3)
    """Sets of seeds to run; the seeds of set i begin at 1000 * i."""
    block: int = 10
    """Number of episodes that a contestant runs per turn."""
    seconds: float = 20.0
    """Seconds for which a case makes plans; it makes at least ten."""


@dataclasses.dataclass(frozen=True)
class Case:
    part: str
    task: str
    contestant: str
    repeat: int
    first: int
    count: int
    steps: int
    seconds: float
    threads: int


def cases(options: Options) -> list[Case]:
    """List the cases of plans, and then the cases of episodes.

    All contestants of a comparison run one after another.
    """
    short, cuda = options.short, options.device.startswith("cuda")
    threads = options.threads or len(os.sched_getaffinity(0)) // max(options.jobs, 1)
    parts = choose(options.parts, ("plans", "episodes"), what="part")
    tasks = choose(options.tasks, TASKS, ("reach",) if short else (), what="task")
    usual = [name for name in CONTESTANTS if cuda or name not in ON_WARP]
    contestants = choose(options.contestants, CONTESTANTS, usual, what="contestant")
    if options.jobs > 1 and ("plans" in parts or {*ON_WARP} & {*contestants}):
        raise ValueError("plans and GPU cases are timed alone: give --jobs 1, or --parts episodes")
    single = [name for name in contestants if name in (*OURS, "python")]
    repeats, count = options.repeats or (1 if short else 5), 2 if short else options.episodes
    seconds = 1.0 if short else options.seconds
    sets = options.sets[:1] if short else options.sets
    if min(count, options.block, repeats) < 1:
        raise ValueError("episodes, block and repeats must be at least 1")
    cases = []
    if "plans" in parts:
        cases += [Case("plans", task, name, repeat, 500 + repeat, 0, 10 if short else 75, seconds, threads)
                  for repeat in range(repeats) for task in PLANS if task in tasks for name in single]  # fmt: skip
    if "episodes" in parts:
        episode_tasks = [task for task in EPISODES if task in tasks and (options.tasks or task in PAPER)]
        blocks = [(first, min(options.block, count - first), single) for first in range(0, count, options.block)]
        blocks.append((0, count, [name for name in contestants if name in TOGETHER]))
        cases += [
            Case("episodes", task, name, number, 1000 * number + first, size, 10 if short else EPISODES[task], 0.0,
                 threads)
            for number in sets for first, size, names in blocks for task in episode_tasks for name in names
        ]  # fmt: skip
    return [case for case in cases if case.contestant != "mppi_fast" or "fast" in find_task(case.task).physics]


def estimate(case: Case) -> float:
    if case.part == "plans":
        return 2.0 * case.seconds
    plan = {"reach": 0.003, "half_cheetah": 0.03}.get(case.task, 0.5)
    return case.count * case.steps * plan * max(2 / case.threads, 0.1)


# later cases reuse these planners and plants


@functools.cache
def planner(task: str, contestant: str, threads: int, device: str, plants: int = 1) -> lw.MPPI:
    if contestant in ON_WARP:
        return lw.MPPI(task, engine="warp", device=device, plants=plants)
    physics = "fast" if contestant == "mppi_fast" else "exact"
    return lw.MPPI(task, engine="mujoco", nthread=threads, plants=plants, physics=physics)


@functools.cache
def python_planner(task: str, threads: int) -> Any:
    return python_mppi.PythonMPPI(task, planner(task, "mppi", threads, "cpu"), threads)


@functools.cache
def plant(task: str, steps: int, nworld: int = 1, threads: int = 1) -> lw.Env:
    return lw.make(task, nworld=nworld, autoreset=False, horizon=steps, engine="mujoco", nthread=threads)


def controller(case: Case, options: Options) -> Any:
    if case.contestant == "python":
        return python_planner(case.task, case.threads)
    return planner(case.task, case.contestant, case.threads, options.device)


# episodes


def run_episodes(case: Case, options: Options) -> dict[str, Any]:
    seeds = range(case.first, case.first + case.count)
    plans = {}
    if case.contestant in TOGETHER:
        successes, returns, times = episodes_together(case, options, seeds)
    else:
        control, env = controller(case, options), plant(case.task, case.steps)
        lw.control(env, control, seed=0, steps=3)  # the first plan captures graphs and wakes threads
        episodes = [lw.control(env, control, seed=seed) for seed in seeds]
        successes, returns = (
            [episode.succeeded for episode in episodes],
            [episode.episode_return for episode in episodes],
        )
        times = [episode.wall_seconds for episode in episodes]
        plans["plan_ms"] = 1e3 * torch.cat([episode.plan_times for episode in episodes]).median().item()
    each = [[seed, success, round(value, 4), round(seconds, 4)]
            for seed, success, value, seconds in zip(seeds, successes, returns, times, strict=True)]  # fmt: skip
    return {"successes": sum(successes), "return": statistics.fmean(returns), "each": each,
            "seconds": statistics.fmean(times), **plans}  # fmt: skip


def episodes_together(
    case: Case, options: Options, seeds: Sequence[int]
) -> tuple[list[bool], list[float], list[float]]:
    """Run all episodes with one planner. Return successes, returns, and the wall-clock seconds per episode."""
    planning = planner(case.task, case.contestant, case.threads, options.device, case.count)
    env, one = plant(case.task, case.steps, case.count, case.threads), plant(case.task, case.steps)
    starts = []
    for seed in seeds:
        one.rand_reset(seed)
        starts.append(one.get_state()[0])
    for steps in (min(3, case.steps), case.steps):  # the first steps capture graphs and wake threads
        env.set_state(torch.stack(starts))
        planning.reset(seeds)
        returns = torch.zeros(case.count, dtype=torch.float64)
        success, going = torch.zeros(case.count, dtype=torch.bool), torch.ones(case.count, dtype=torch.bool)
        began = time.perf_counter()
        for step in range(steps):
            env.step(planning(env.get_state(), shift=min(step, 1)))
            returns += torch.where(going, env.reward, 0.0)
            success = torch.where(going, env.success, success)
            going &= ~env.done
            if not going.any():
                break
    seconds = (time.perf_counter() - began) / case.count
    return success.tolist(), returns.tolist(), [seconds] * case.count


# all planners plan from the same states


@functools.cache
def states(task: str, seed: int, steps: int, threads: int) -> torch.Tensor:
    return lw.control(plant(task, steps), planner(task, "mppi", threads, "cpu"), seed=seed).states[:-1]


def run_plans(case: Case, options: Options) -> dict[str, Any]:
    """Measure plans from the states of an episode, without the first four plans."""
    plan, starts = controller(case, options), states(case.task, case.first, case.steps, case.threads)
    plan.reset(case.first)
    times: list[float] = []
    end = time.perf_counter() + case.seconds
    for state in itertools.cycle(starts):
        began = time.perf_counter()
        if len(times) >= 14 and began > end:
            break
        plan(state).cpu()
        times.append(1e3 * (time.perf_counter() - began))
    config = planner(case.task, "mppi", case.threads, "cpu").config
    return {"plans": len(times) - 4, "plan_ms": statistics.median(times[4:]), "samples": config.samples,
            "horizon": config.horizon}  # fmt: skip


RUN = {"plans": run_plans, "episodes": run_episodes}


@torch.no_grad()
def measure(case: Case, options: Options) -> dict[str, Any]:
    if case.task.startswith("adroit"):
        installed("gymnasium_robotics", "gymnasium-robotics")
    # new threads and processes inherit these cores
    with experiment.cores(case.threads):
        return RUN[case.part](case, options)


# tables


def grouped(rows: Sequence[Row], part: str) -> dict[str, dict[str, list[Row]]]:
    groups: dict[str, dict[str, list[Row]]] = {}
    for row in sorted(rows, key=lambda row: TASKS.index(row.case["task"])):
        if row.case["part"] == part:
            groups.setdefault(row.case["task"], {}).setdefault(row.case["contestant"], []).append(row)
    return {task: {name: same[name] for name in CONTESTANTS if name in same} for task, same in groups.items()}


def tables(rows: Sequence[Row]) -> list[Table]:
    makers = {"episodes": episode_table, "plans": plan_table}
    return [make(groups) for part, make in makers.items() if (groups := grouped(rows, part))]


def episodes_of(rows: Sequence[Row]) -> dict[int, dict[int, list[Any]]]:
    """Sort the episodes by set and seed.

    An episode is (seed, success, return, seconds). The seconds are None if the episode was not timed.
    """
    sets: dict[int, dict[int, list[Any]]] = {}
    for row in rows:
        sets.setdefault(row.case["repeat"], {}).update({episode[0]: episode for episode in row.result["each"]})
    return sets


def flat(rows: Sequence[Row]) -> list[list[Any]]:
    return [episode for same in episodes_of(rows).values() for episode in same.values()]


def mean_seconds(each: Sequence[Sequence[Any]]) -> float | None:
    timed = [episode[3] for episode in each if episode[3] is not None]
    return statistics.fmean(timed) if timed else None


def episode_table(groups: dict[str, dict[str, list[Row]]]) -> Table:
    lines = []
    for task, same in groups.items():
        for name, group in same.items():
            sets, each = episodes_of(group), flat(group)
            good = sum(int(episode[1]) for episode in each)
            low, high = wilson(good, len(each))
            by_set = ", ".join(f"{i}: {sum(int(e[1]) for e in sets[i].values())}/{len(sets[i])}" for i in sorted(sets))
            times = []
            for i, ours in episodes_of(same.get("mppi", ())).items():
                both = [(sets[i][seed][3], ours[seed][3]) for seed in ours.keys() & sets.get(i, {}).keys()]
                if both := [pair for pair in both if None not in pair]:
                    times.append(sum(pair[0] for pair in both) / sum(pair[1] for pair in both))
            seconds = mean_seconds(each)
            cores = ", ".join(map(str, sorted({row.case["threads"] for row in group})))
            lines.append([
                task, CONTESTANTS[name], cores, f"{good} of {len(each)}", f"{low:.0%} to {high:.0%}", by_set,
                "" if seconds is None else f"{seconds:.3g}", median_and_range(times),
            ])  # fmt: skip
    title = (
        "Episodes: success with its 95 % interval (Wilson), successes of each set of seeds, and mean seconds of the "
        "timed episodes; for a set at a time, the set's seconds divided by its episodes. The last column compares the "
        "same seeds: median over the sets (smallest to largest)."
    )
    header = ["task", "planner", "cores", "successes", "interval", "sets", "seconds", "relative to lyceum_warp's"]
    return Table(title, header, lines)


def plan_table(groups: dict[str, dict[str, list[Row]]]) -> Table:
    lines = []
    for task, same in groups.items():
        every = [row for group in same.values() for row in group]
        ratios = experiment.paired(every, "plan_ms", "mppi")
        for name, group in same.items():
            size = group[0].result
            lines.append([
                task, f"{size['samples']} x {size['horizon']}", CONTESTANTS[name],
                median_and_range([row.result["plan_ms"] for row in group], ".4g"), median_and_range(ratios[name]),
            ])  # fmt: skip
    header = ["task", "samples x horizon", "planner", "plan, ms", "relative to lyceum_warp's"]
    return Table("A plan: medians over the repeats (smallest to largest).", header, lines)


EXPERIMENT = experiment.Experiment(
    name="mppi",
    conditions="Plants run on the C engine with exact physics. Planners use exact physics on the C engine (unless a "
    "table says otherwise), and the physics that the task suggests on the Warp engine.",
    summary="MPPI and a Python planner: episode results and planning time.",
    cases=cases, estimate=estimate, measure=measure, tables=tables, options=Options,
    packages=("gymnasium-robotics",), parallel=True,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
