"""Latency of a controller: how long MPPI takes for a plan, and whether plans are there when a world needs them.

    lyceum-warp bench latency --device cuda
    lyceum-warp bench latency --tasks reach --samples 64 256 --horizons 32

Each case is a planner with a number of samples and steps. Planning time: the planner has all threads, and the world
waits for each plan, until there are 1,000 plans or the time is over; the time ends when the plan has reached the CPU.
Real time: the world keeps its rate by the wall clock on a core of its own, while the planner plans in a second thread
with the threads that are left, always from the newest state. A deadline is met where a plan takes at most one step of
the world. The age of an action is the time, in the world's steps, from the state that its plan began with to its use; 1
is the least for a planner that does not stop the world. Nothing else should run on the machine meanwhile.

The last case is a planner that is slowed down on purpose, to several steps of the world: what a planner that is too
slow looks like.
"""

import dataclasses
import gc
import math
import sys
import time
from collections.abc import Sequence
from typing import Any

import experiment
import torch
from experiment import Experiment, Row, Skipped, Table
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

import lyceum_warp as lw
from lyceum_warp.controllers.control_report import ControlReport
from lyceum_warp.engines.memory import NotEnoughMemoryError
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.support.validate import positive_number, whole_number
from lyceum_warp.viz.style import new_figure

C, WARP = "c", "warp"
ENGINES = {C: "mujoco", WARP: "warp"}
LABELS = {C: "C engine", WARP: "Warp engine"}

TASKS = ("cartpole_swingup", "reach", "half_cheetah", "adroit_pen", "herb_reach", "humanoid")
"""From few to many degrees of freedom; two with a hand or arms in contact."""

SLOWED = ("reach", 16, 32)
"""Task, samples and horizon of the planner that is slowed down, too."""

PLANS = 1000
"""Most plans for the planning time."""

LONGEST = 5.0
"""Seconds of a plan from which on it is measured once, and not in real time."""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    """Latency of MPPI."""

    samples: tuple[int, ...] = (16, 64, 256, 1024, 4096)
    """Numbers of samples."""
    horizons: tuple[int, ...] = (8, 32, 128)
    """Steps of a plan."""
    seconds: float = 4.0
    """Time for the planning time, and again for real time."""
    slow: tuple[float, ...] = (2.5,)
    """Steps of the world that a planner takes at least that is slowed down."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One planner."""

    task: str
    contestant: str
    """Engine of the planner."""
    device: str
    threads: int
    """Threads of the C engine for the planning time, and cores in real time."""
    samples: int
    horizon: int
    slow: float
    """Steps of the world that a plan takes at least; 0 for a planner as it is."""
    seconds: float
    seed: int
    repeat: int


def cases(options: Options) -> list[Case]:
    tasks = experiment.choose(
        options.tasks, lw.task_names(), (SLOWED[0],) if options.short else TASKS, what="task"
    )  # fmt: skip
    # without a GPU the Warp engine, which has one thread there, takes part only if it is asked for
    gpu = options.device.startswith("cuda")
    contestants = experiment.choose(options.contestants, ENGINES, (C, WARP) if gpu else (C,), what="contestant")
    seconds = positive_number("--seconds", options.seconds, "seconds")
    for name in ("samples", "horizons"):
        for value in getattr(options, name):
            whole_number(f"--{name}", value, low=1)
    for value in options.slow:
        positive_number("--slow", value, "steps")
    sizes = [(samples, horizon) for horizon in options.horizons for samples in options.samples]
    if options.short:
        sizes, seconds = [(16, 8), SLOWED[1:]], min(seconds, 1.0)
    planners: list[tuple[str, int, int, float]] = [(task, *size, 0.0) for task in tasks for size in sizes]
    if SLOWED[0] in tasks:
        planners += [(*SLOWED, slow) for slow in options.slow]
    threads = cpu_cores() if options.threads is None else whole_number("--threads", options.threads, low=1)
    return [
        Case(task, contestant, options.device if contestant == WARP else "cpu", threads, samples, horizon, slow,
             seconds, seed, repeat)
        for repeat in range(options.repeats or 1)
        for seed in options.seeds or (0,)
        for task, samples, horizon, slow in planners
        for contestant in contestants
        if not slow or contestant == contestants[0]
    ]  # fmt: skip


def estimate(case: Case) -> float:
    return 2.0 * case.seconds + 4.0


class Slowed:
    """A planner that waits after each plan until a given time has passed."""

    def __init__(self, plan: lw.MPPI, seconds: float) -> None:
        self.plan, self.seconds = plan, seconds
        self.timestep, self.reset, self.samples = plan.timestep, plan.reset, plan.samples

    @property
    def actions(self) -> torch.Tensor:
        return self.plan.actions

    @property
    def summary(self) -> dict[str, float]:
        return self.plan.summary

    def __call__(self, state: torch.Tensor, obs: torch.Tensor, *, shift: int = 1) -> torch.Tensor:
        due = time.perf_counter() + self.seconds
        action = self.plan(state, obs, shift=shift)
        time.sleep(max(0.0, due - time.perf_counter()))
        return action


def planner(case: Case, threads: int, timestep: float) -> lw.MPPI | Slowed:
    engine: dict[str, Any] = {"engine": ENGINES[case.contestant], "device": case.device}
    if case.contestant == C:
        engine["nthread"] = threads
    try:
        plan = lw.MPPI(case.task, samples=case.samples, horizon=case.horizon, seed=case.seed, **engine)
    except NotEnoughMemoryError as error:
        raise Skipped(f"{case.task}, {case.samples} samples of {case.horizon} steps: {error}") from error
    return Slowed(plan, case.slow * timestep) if case.slow else plan


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    try:
        # no horizon: an episode ends only where the task ends it
        plant = lw.make(case.task, engine="mujoco", nthread=1, autoreset=False, horizon=0, seed=case.seed)
    except (FileNotFoundError, ImportError) as error:
        raise Skipped(f"{case.task}: {error}") from error
    plan = planner(case, case.threads, plant.timestep)
    took = first_plans(plan, plant, compiled=case.contestant == C)
    found: dict[str, Any] = {"period_ms": 1e3 * plant.timestep, "plans": 1, "median_ms": 1e3 * took, "p99_ms": None,
                             "max_ms": 1e3 * took, "in_time": float(took <= plant.timestep)}  # fmt: skip
    if took <= LONGEST:
        found |= planning_time(waiting(plant, plan, case, took))
    if 4 * took < case.seconds and took <= LONGEST:
        left = case.threads
        if case.contestant == C and case.threads > 1:
            left, plan = case.threads - 1, planner(case, case.threads - 1, plant.timestep)
        found |= real_time(keeping_its_rate(plant, plan, case)) | {"real_time_threads": left}
    del plan, plant
    gc.collect()  # the worlds' memory, before the next planner's
    return found


def first_plans(plan: lw.MPPI | Slowed, plant: lw.Env, *, compiled: bool) -> float:
    """Plan until every kernel is loaded and graphs are captured; returns the seconds of the last of these plans.

    One plan that takes too long is enough; but the Warp engine's first two compile kernels and capture graphs.
    """
    state, obs = plant.get_state()[0], plant.obs[0]
    for count in range(4):
        began = time.perf_counter()
        plan(state, obs)
        plan.actions.cpu()
        took = time.perf_counter() - began
        if took > LONGEST and (count > 1 or compiled):
            break
    return took


def waiting(plant: lw.Env, plan: lw.MPPI | Slowed, case: Case, took: float) -> ControlReport:
    """Episodes in which the world waits for each plan."""
    episodes: list[lw.Trajectory] = []
    left, end = max(10, min(PLANS, int(case.seconds / took))), time.perf_counter() + 1.5 * case.seconds
    while left > 0 and (not episodes or time.perf_counter() < end):
        episodes.append(lw.control(plant, plan, steps=left, seed=case.seed + len(episodes)))
        left -= episodes[-1].steps
    return lw.control_report(episodes)


def keeping_its_rate(plant: lw.Env, plan: lw.MPPI | Slowed, case: Case) -> ControlReport:
    """Episodes in which the world keeps its rate."""
    episodes: list[lw.Trajectory] = []
    left, end = case.seconds, time.perf_counter() + 1.5 * case.seconds
    while left > 0 and (not episodes or time.perf_counter() < end):
        seed = case.seed + len(episodes)
        episodes.append(lw.control_async(plant, plan, seconds=max(left, plant.timestep), seed=seed))
        left -= episodes[-1].wall_seconds
    return lw.control_report(episodes)


def planning_time(report: ControlReport) -> dict[str, Any]:
    if not report.plans:  # an episode ended after its first plan
        return {}
    return {
        "plans": report.plans, "median_ms": report.plan_p50_ms or report.plan_mean_ms, "p99_ms": report.plan_p99_ms,
        "max_ms": report.plan_max_ms, "in_time": 1.0 - (report.miss_share or 0.0),
    }  # fmt: skip


def real_time(report: ControlReport) -> dict[str, Any]:
    return {
        "real_time_plans": report.plans,
        "real_time_median_ms": report.plan_p50_ms,
        "real_time_p99_ms": report.plan_p99_ms,
        "real_time_max_ms": report.plan_max_ms,
        "met": None if report.miss_share is None else 1.0 - report.miss_share,
        "age_mean": report.age_steps_mean,
        "age_max": report.age_steps_max,
        "age_mean_ms": report.age_mean_ms,
        "age_max_ms": report.age_max_ms,
        "late_steps": report.late_ticks,
        "steps": report.steps,
        "step_delay_max_ms": report.tick_delay_max_ms,
        "mean_reward": report.return_mean * report.episodes / report.steps,
    }


# tables and figure


def tables(rows: Sequence[Row]) -> list[Table]:
    header = ("task", "engine", "samples", "horizon", "plan: median, ms", "99 %", "max", "step, ms",
              "real time: deadlines met", "age, steps: mean", "max", "late steps")  # fmt: skip
    title = (
        "Planning time of MPPI, and control in real time: plans that took at most one step of the world, age of the "
        "applied actions in steps, and steps of the world that began late. A planner marked with × was slowed down on "
        "purpose, to as many steps. A time above 5 s is that of a single plan, on the C engine the planner's first."
    )
    return [Table(title, header, [cells(row) for row in rows])] if rows else []


def cells(row: Row) -> list[str]:
    case, result = row.case, row.result

    def number(name: str, form: str = ".3g") -> str:
        value = result.get(name)
        return "" if value is None else format(value, form if abs(value) < 1000 else ".0f")

    late = "" if result.get("late_steps") is None else f"{result['late_steps']} of {result['steps']}"
    return [
        case["task"], LABELS[case["contestant"]] + (f", × {case['slow']:g}" if case["slow"] else ""),
        str(case["samples"]), str(case["horizon"]), number("median_ms"), number("p99_ms"), number("max_ms"),
        number("period_ms"), number("met", ".1%"), number("age_mean"), number("age_max"), late,
    ]  # fmt: skip


def figure(rows: Sequence[Row]) -> Figure:
    """A map for each task and engine: median planning time over samples and horizon, against the world's step."""
    rows = [row for row in rows if not row.case["slow"]]
    if not rows:
        raise ValueError("the results have no planning times to draw")
    tasks = list(dict.fromkeys(row.case["task"] for row in rows))
    engines = [name for name in ENGINES if any(row.case["contestant"] == name for row in rows)]
    samples, horizons = (sorted({row.case[name] for row in rows}) for name in ("samples", "horizon"))
    across = min(3, len(tasks))
    places = [(tasks[i : i + across], engine) for i in range(0, len(tasks), across) for engine in engines]
    wide, high = max(2.2, 0.7 + 0.45 * len(samples)), 0.8 + 0.38 * len(horizons)
    drawn: Figure = new_figure("planning times", max(4.5, wide * across) + 1.2, high * len(places) + 0.8)
    panels = drawn.subplots(len(places), across, squeeze=False)
    for i, (group, engine) in enumerate(places):
        for j, axes in enumerate(panels[i]):
            if j >= len(group):
                axes.set_visible(False)
                continue
            heights = [[math.nan] * len(samples) for _ in horizons]
            for row in rows:
                if (row.case["task"], row.case["contestant"]) == (group[j], engine):
                    y, x = horizons.index(row.case["horizon"]), samples.index(row.case["samples"])
                    heights[y][x] = math.log10(row.result["median_ms"] / row.result["period_ms"])
                    write(axes, x, y, row)
            image = axes.imshow(heights, cmap="RdYlBu_r", norm=TwoSlopeNorm(0.0, -2.0, 2.0), origin="lower",
                                aspect="auto")  # fmt: skip
            axes.set_xticks(range(len(samples)), [str(n) for n in samples], fontsize=7)
            axes.set_yticks(range(len(horizons)), [str(n) for n in horizons], fontsize=7)
            axes.tick_params(length=0)
            axes.spines[:].set_visible(False)
            axes.set_title(f"{group[j]}, {LABELS[engine]}", loc="left", fontsize=8)
            if i == len(places) - 1:
                axes.set_xlabel("samples", fontsize=8)
            if j == 0:
                axes.set_ylabel("horizon, steps", fontsize=8)
    bar = drawn.colorbar(image, ax=panels.ravel().tolist(), ticks=[-2, -1, 0, 1, 2], shrink=0.9)
    bar.ax.set_yticklabels(["0.01", "0.1", "1", "10", "100"], fontsize=7)
    bar.set_label("planning time by the world's step", fontsize=8)
    drawn.suptitle("Median planning time in ms; bold where 99 % of the plans meet the deadline in real time", x=0.01,
                   ha="left", fontsize=9)  # fmt: skip
    return drawn


def write(axes: Any, x: int, y: int, row: Row) -> None:
    """Write a planning time into its cell."""
    value, met = row.result["median_ms"], row.result.get("met")
    dark = not 0.05 < value / row.result["period_ms"] < 20.0
    axes.text(x, y, f"{value:.2g}" if value < 10 else f"{value:,.0f}", ha="center", va="center", fontsize=7,
              color="white" if dark else "black",
              fontweight="bold" if met is not None and met >= 0.99 else "normal")  # fmt: skip


EXPERIMENT = Experiment(
    name="latency",
    summary="planning time, deadlines and ages of actions over model, samples and horizon",
    cases=cases, estimate=estimate, measure=measure, tables=tables, figure=figure, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
