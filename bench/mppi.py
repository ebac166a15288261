"""MPPI in episodes and in planning time, beside Python, the bare engines and other libraries (the paper's table).

    lyceum-warp bench mppi --threads 16
    lyceum-warp bench mppi --threads 16 --device cuda

Three parts. *Episodes*: the paper's two planning tasks with its settings and its 75 steps, success and time. *Plans*:
the time of a plan from the same states, the bare engine's time for the same rollouts from the same state under the same
controls taking turns with ours at every plan. *Cartpole*: judo, with our model and reward, at equal samples, horizon
and substeps. (hydrax has no release on the package index, where its name is that of another project.)

The Python planners (``python_mppi.py``) are a careful one with a message a plan, and the simple one that the paper
measured, with a message a step. All planners control the same plant, and take turns in blocks of episodes. The
contestants "a set at a time" have their turn after them: one planner controls the plants of all episodes of a set.

With --parts episodes --jobs N, N blocks run at a time, each in a process with cores of its own: successes stay the
same, while times are those of cores whose neighbours work. With --busy episodes have no times.
"""

import dataclasses
import functools
import itertools
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import comparison
import experiment
import mujoco_warp as mjw
import numpy as np
import peers
import python_mppi
import torch
import warp as wp
from experiment import Row, Skipped, Table, choose, installed, median_and_range
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter
from mujoco.batch import Batch

import lyceum_warp as lw
from lyceum_warp.controllers.control_statistics import wilson
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.engines.warp.warp_engine import WarpEngine
from lyceum_warp.viz.style import finish_axes

EPISODES = ("reach", "adroit_pen")
PLANS = ("reach", "half_cheetah", "adroit_pen")
CARTPOLE = "cartpole_swingup"
TASKS = (*PLANS, CARTPOLE)

CONTESTANTS = {
    "mppi": "ours, C engine",
    "mppi_warp": "ours, Warp engine",
    "mppi_together": "ours, C engine, a set at a time",
    "mppi_warp_together": "ours, Warp engine, a set at a time",
    "python": "Python, a message a plan",
    "python_stepwise": "Python, a message a step",
    "judo": "judo",
}
OURS, TOGETHER = ("mppi", "mppi_warp"), ("mppi_together", "mppi_warp_together")
PYTHON, PEERS = ("python", "python_stepwise"), ("judo",)
ON_WARP = ("mppi_warp", "mppi_warp_together")

COLORS = dict(
    zip(CONTESTANTS, ("#c8502d", "#d99a2b", "#a33d1d", "#a87312", "#3d6fa5", "#8a6bb1", "#5a8f4e"), strict=True)
)

PLAN_MS = {
    "reach": {"mppi": 3.0, "mppi_warp": 12.0, "mppi_warp_together": 0.2, "python": 5.4, "python_stepwise": 60.0},
    "half_cheetah": {"mppi": 27.0, "mppi_warp": 55.0, "python": 38.0, "python_stepwise": 120.0},
    "adroit_pen": {
        "mppi": 514.0,
        "mppi_warp": 500.0,
        "mppi_warp_together": 30.0,
        "python": 603.0,
        "python_stepwise": 1600.0,
    },
    CARTPOLE: {"mppi": 23.0, "mppi_warp": 60.0, "judo": 28.0},
}
"""Rough time of a plan on two cores, or on a GPU; with several plants, its share for each."""

STEPS, CARTPOLE_STEPS = 75, 400
"""Steps of an episode: the paper's, and four seconds."""

SWINGUP: dict[str, Any] = {"horizon": 100, "temperature": 0.1, "noise": 0.5}
"""Settings of all planners of cartpole: a second in steps, units of reward, and of the action."""

KNOTS = 10
"""Knots of the spline over cartpole's horizon: linear between them, a tenth of a second apart."""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    """Episodes under MPPI and the time of its plans."""

    parts: tuple[str, ...] = ()
    """Parts: plans, episodes, cartpole; by default all."""
    episodes: int = 100
    """Episodes of each set of seeds."""
    sets: tuple[int, ...] = (1, 2, 3)
    """Numbers of the sets of seeds. Set i begins at seed 1000 i; set 0 chose nothing, but was published before."""
    block: int = 10
    """Episodes of a contestant before the next one's turn."""
    busy: bool = False
    """Other programs use this machine, too: keep the episodes' successes, and no times."""
    seconds: float = 20.0
    """Time for the plans of a case, at least ten plans."""


@dataclasses.dataclass(frozen=True)
class Case:
    """A block of episodes, or some plans, of one contestant."""

    part: str
    task: str
    contestant: str
    repeat: int
    """Number of the repeat, or of the set of seeds."""
    first: int
    """The first seed."""
    count: int
    """Episodes."""
    steps: int
    """Steps of an episode."""
    samples: int | None
    """Samples of a plan, where they are not the task's own."""
    seconds: float
    """Time for plans, where they are not those of episodes."""
    threads: int


def cases(options: Options) -> list[Case]:
    """Plans, then episodes, then cartpole; contestants that are compared follow one another."""
    short, cuda = options.short, options.device.startswith("cuda")
    threads = options.threads or len(os.sched_getaffinity(0)) // max(options.jobs, 1)
    parts = choose(options.parts, ("plans", "episodes", "cartpole"), what="part")
    tasks = choose(options.tasks, TASKS, ("reach",) if short else (), what="task")
    usual = [name for name in (*OURS, *TOGETHER, *PYTHON, *PEERS)
             if (cuda or name not in ON_WARP) and not (short and name in PEERS)]  # fmt: skip
    contestants = choose(options.contestants, CONTESTANTS, usual, what="contestant")
    if options.jobs > 1 and (parts != ("episodes",) or {*ON_WARP} & {*contestants}):
        raise ValueError("plans, cartpole and a GPU are timed alone, so that jobs must be 1: or give --parts episodes")
    # a part without a contestant that has its tasks would be measured for nothing
    simulated = [name for name in contestants if name in (*OURS, *PYTHON)]
    planning = [name for name in contestants if name in (*OURS, *PEERS)]
    together = [name for name in contestants if name in TOGETHER]
    repeats, count = options.repeats or (1 if short else 5), 2 if short else options.episodes
    seconds, steps = (1.0, 10) if short else (options.seconds, STEPS)
    sets = options.sets[:1] if short else options.sets
    if min(count, options.block, repeats, *sets) < 1:
        raise ValueError("episodes, block, repeats and the numbers of the sets must be at least 1")
    plans = [
        Case("plans", task, name, repeat, 500 + repeat, 0, steps, None, seconds, threads)
        for repeat in range(repeats) for task in PLANS for name in simulated
        if "plans" in parts and task in tasks
    ]  # fmt: skip
    episodes = [
        Case("episodes", task, name, number, 1000 * number + first, size, steps, None, 0.0, threads)
        for number in sets
        for first, size, names in (
            *((first, min(options.block, count - first), simulated) for first in range(0, count, options.block)),
            (0, count, together),
        )
        for task in EPISODES for name in names
        if "episodes" in parts and task in tasks
    ]  # fmt: skip
    cartpole = [
        Case("cartpole", CARTPOLE, name, repeat, 10 * repeat, 2 if short else 5, 20 if short else CARTPOLE_STEPS,
             samples, 0.0, threads)
        for repeat in range(repeats) for samples in ((16,) if short else (64, 256)) for name in planning
        if "cartpole" in parts and CARTPOLE in tasks
    ]  # fmt: skip
    return [*plans, *episodes, *cartpole]


def estimate(case: Case) -> float:
    times = PLAN_MS[case.task]
    plan = 1e-3 * times.get(case.contestant, times["mppi"])
    if case.samples is not None:
        plan *= case.samples / 64
    if case.contestant not in ON_WARP:
        plan *= max(2 / case.threads, 0.1)
    if case.part == "plans":
        # the states come from an episode, which the first contestant waits for
        return max(case.seconds, 10 * plan) * (2.0 if case.contestant in OURS else 1.0)
    return case.count * case.steps * plan


# planners and plants; they stay for the next cases


@functools.cache
def planner(
    task: str, contestant: str, threads: int, device: str, samples: int | None = None, plants: int = 1
) -> lw.MPPI:
    """Ours; its settings are the task's own, but on cartpole those that all contestants have."""
    more: dict[str, Any] = {"plants": plants}
    if samples is not None:
        more |= SWINGUP | {"samples": samples, "knots": KNOTS, "spline": "linear", "fill": "repeat"}
    if contestant in ON_WARP:
        return lw.MPPI(task, engine="warp", device=device, **more)
    return lw.MPPI(task, engine="mujoco", nthread=threads, **more)


@functools.cache
def python_planner(task: str, contestant: str, threads: int) -> Any:
    """Python's, with as many processes as threads; they wait for messages while others plan."""
    kind = {"python": python_mppi.PythonMPPI, "python_stepwise": python_mppi.StepwiseMPPI}[contestant]
    try:
        return kind(task, planner(task, "mppi", threads, "cpu"), threads)
    except (EOFError, ConnectionError) as error:
        raise Skipped(f"Python's environment of {task} cannot be made: its process ended, see above") from error


@functools.cache
def plant(task: str, steps: int, nworld: int = 1, threads: int = 1) -> lw.Env:
    return lw.make(task, nworld=nworld, autoreset=False, horizon=steps, engine="mujoco", nthread=threads)


def controller(case: Case, options: Options) -> Any:
    if case.contestant in PYTHON:
        return python_planner(case.task, case.contestant, case.threads)
    return planner(case.task, case.contestant, case.threads, options.device, case.samples)


# episodes


def run_episodes(case: Case, options: Options) -> dict[str, Any]:
    """A block of episodes, one after the other or all together."""
    seeds = range(case.first, case.first + case.count)
    plans = {}
    if case.contestant in TOGETHER:
        successes, returns, times = episodes_together(case, options, seeds)
    else:
        made, env = controller(case, options), plant(case.task, case.steps)
        lw.control(env, made, seed=0, steps=3)  # captures graphs and wakes threads
        done = [lw.control(env, made, seed=seed) for seed in seeds]
        successes, returns = [episode.succeeded for episode in done], [episode.episode_return for episode in done]
        times = [episode.wall_seconds for episode in done]
        plans["plan_ms"] = 1e3 * torch.cat([episode.plan_times for episode in done]).median().item()
    kept = [None if options.busy else round(seconds, 4) for seconds in times]
    each = [list(row) for row in zip(seeds, successes, [round(value, 4) for value in returns], kept, strict=True)]
    found: dict[str, Any] = {"successes": sum(successes), "return": statistics.fmean(returns), "each": each}
    return found if options.busy else found | {"seconds": statistics.fmean(times)} | plans


def episodes_together(
    case: Case, options: Options, seeds: Sequence[int]
) -> tuple[list[bool], list[float], list[float]]:
    """The same episodes with one planner for all plants: successes, returns, and each one's share of the time."""
    made = planner(case.task, case.contestant, case.threads, options.device, None, case.count)
    env, one = plant(case.task, case.steps, case.count, case.threads), plant(case.task, case.steps)
    starts = []
    for seed in seeds:
        one.rand_reset(seed)
        starts.append(one.get_state()[0])
    for steps in (min(3, case.steps), case.steps):  # the first ones capture graphs and wake threads
        env.set_state(torch.stack(starts))
        made.reset(seeds)
        returns = torch.zeros(case.count, dtype=torch.float64)
        success, going = (torch.full((case.count,), value) for value in (False, True))
        began = time.perf_counter()
        for step in range(steps):
            env.step(made(env.get_state(), shift=min(step, 1)))
            returns += torch.where(going, env.reward, 0.0)
            success = torch.where(going, env.success, success)
            going &= ~env.done
            if not going.any():
                break
    seconds = (time.perf_counter() - began) / case.count
    return success.tolist(), returns.tolist(), [seconds] * case.count


# plans from the same states


class BareC:
    """One ``Batch.rollout`` of a plan's samples."""

    def __init__(self, plan: lw.MPPI) -> None:
        self.plan, engine, self.nstep = plan, plan.env.engine, plan.env.task.frame_skip
        assert isinstance(engine, MujocoEngine)
        self.size = engine.integration_size
        self.batch = Batch(engine.native_model, plan.samples, engine.nthread)
        self.control = np.zeros((plan.samples, plan.horizon * self.nstep, engine.model.nu))
        self.results = None

    def load(self, state: torch.Tensor) -> None:
        """The last plan's state and samples."""
        self.batch.state[:] = state[: self.size].numpy()
        self.control[:] = np.repeat(self.plan._loop._controls.numpy().transpose(1, 0, 2), self.nstep, axis=1)

    def __call__(self) -> None:
        self.results = self.batch.rollout(
            self.control.shape[1], self.control, record=["qpos", "qvel"], out=self.results
        )  # fmt: skip


class BareWarp:
    """One graph of ``mujoco_warp.step`` for a plan's samples."""

    def __init__(self, plan: lw.MPPI) -> None:
        env, engine = plan.env, plan.env.engine
        assert isinstance(engine, WarpEngine)
        self.plan, self.env, self.size = plan, env, engine.integration_size
        with wp.ScopedDevice(env.device):
            self.m, self.d = engine.bare()
            self.state = wp.zeros((env.nworld, self.size), dtype=float)
            self.controls = wp.zeros((plan.horizon, env.nworld, env.model.nu), dtype=float)
            mjw.step(self.m, self.d)
            with wp.ScopedCapture() as capture:
                for t in range(plan.horizon):
                    wp.copy(self.d.ctrl, self.controls[t])
                    for _ in range(env.task.frame_skip):
                        mjw.step(self.m, self.d)
        self.graph = capture.graph

    def load(self, state: torch.Tensor) -> None:
        """The last plan's state and samples."""
        wp.to_torch(self.state).copy_(state[: self.size].float().expand(self.env.nworld, -1))
        wp.copy(self.controls, self.plan._loop._controls)
        with wp.ScopedDevice(self.env.device):
            mjw.reset_data(self.m, self.d)
            mjw.set_state(self.m, self.d, self.state, python_mppi.STATE)
        synchronize(self.env)

    def __call__(self) -> None:
        wp.capture_launch(self.graph)


def synchronize(env: lw.Env) -> None:
    if not env.device.is_cpu:
        wp.synchronize_device(env.device)


def timed(function: Callable[[], object], env: lw.Env | None = None) -> float:
    """Milliseconds of a call, the device's work included."""
    if env is not None:
        synchronize(env)
    start = time.perf_counter()
    function()
    if env is not None:
        synchronize(env)
    return 1e3 * (time.perf_counter() - start)


@functools.cache
def states(task: str, seed: int, steps: int, threads: int) -> torch.Tensor:
    """The states of an episode under our planner, (steps, state_size); all contestants plan from them."""
    return lw.control(plant(task, steps), planner(task, "mppi", threads, "cpu"), seed=seed).states[:-1]


@functools.cache
def bare_engine(plan: lw.MPPI) -> BareC | BareWarp:
    return BareC(plan) if isinstance(plan.env.engine, MujocoEngine) else BareWarp(plan)


def run_plans(case: Case, options: Options) -> dict[str, Any]:
    """Plans from the states of an episode, as many as fit into the time; the first four do not count."""
    made, given = controller(case, options), states(case.task, case.first, case.steps, case.threads)
    made.reset(case.first)
    ours = isinstance(made, lw.MPPI)
    bare = bare_engine(made) if ours else None
    env = made.env if ours else None
    times: list[tuple[float, float]] = []
    began, before = time.perf_counter(), given[0]
    made(before)
    for i, state in enumerate(itertools.cycle(given)):
        if i >= 14 and time.perf_counter() - began > case.seconds:
            break
        if bare is None:
            times.append((timed(lambda state=state: made(state)), 0.0))
            continue
        # the first of the two wakes the threads, so they take turns at being first
        if first := i % 2 == 0:
            spent = timed(lambda state=state: made(state), env)
        bare.load(state if first else before)
        alone = timed(bare, env)
        if not first:
            spent = timed(lambda state=state: made(state), env)
        times.append((spent, alone))
        before = state
    times = times[4:]
    plans = sorted(spent for spent, _ in times)
    found: dict[str, Any] = {"plans": len(times), "plan_ms": statistics.median(plans)}
    if len(plans) >= 200:
        found["plan_ms_p99"] = plans[int(0.99 * len(plans))]
    if bare is not None:
        found["bare_ms"] = statistics.median(alone for _, alone in times)
        found["kept"] = statistics.median(alone / spent for spent, alone in times)
    config = planner(case.task, "mppi", case.threads, "cpu").config
    return found | {"samples": config.samples, "horizon": config.horizon}


# cartpole, beside other libraries


def run_cartpole(case: Case, options: Options) -> dict[str, Any]:
    """Episodes of cartpole_swingup from the same initial states."""
    assert case.samples is not None
    env = plant(CARTPOLE, case.steps)
    if case.contestant in PEERS:
        starts = []
        for i in range(case.count):
            env.rand_reset(case.first + i)
            parts, state = env.state_space.parts, env.get_state()[0]
            starts.append({name: state[parts[name]].tolist() for name in ("qpos", "qvel")})
        found = peers.peer(case.contestant).run(
            model=str(Path(lw.__file__).parent / "tasks" / "cartpole.xml"), starts=starts, steps=case.steps,
            samples=case.samples, knots=KNOTS, seed=case.repeat, **SWINGUP,
        )  # fmt: skip
        return found | {"return": statistics.fmean(found["returns"])}
    made = controller(case, options)
    lw.control(env, made, seed=0, steps=3)  # captures graphs and wakes threads
    done = [lw.control(env, made, seed=case.first + i) for i in range(case.count)]
    returns = [round(episode.episode_return, 4) for episode in done]
    plans = torch.cat([episode.plan_times for episode in done])
    return {"plan_ms": 1e3 * plans.median().item(), "return": statistics.fmean(returns), "returns": returns}


RUN = {"plans": run_plans, "episodes": run_episodes, "cartpole": run_cartpole}


@torch.no_grad()
def measure(case: Case, options: Options) -> dict[str, Any]:
    if case.task == "adroit_pen":
        installed("gymnasium_robotics", "gymnasium-robotics")
    # threads and processes that start now use these cores alone
    with experiment.cores(case.threads):
        return RUN[case.part](case, options)


# tables and figure


def grouped(rows: Sequence[Row], part: str) -> dict[tuple[str, int | None], dict[str, list[Row]]]:
    """Rows of a part by task and samples, and by contestant."""
    found: dict[tuple[str, int | None], dict[str, list[Row]]] = {}
    order = sorted(rows, key=lambda row: (TASKS.index(row.case["task"]), row.case["samples"] or 0))
    for row in order:
        if row.case["part"] == part:
            place = row.case["task"], row.case["samples"]
            found.setdefault(place, {}).setdefault(row.case["contestant"], []).append(row)
    return {place: {name: same[name] for name in CONTESTANTS if name in same} for place, same in found.items()}


def ratios(rows: Sequence[Row], units: Sequence[Row], quantity: str, unit: str | None = None) -> list[float]:
    """Ratios of a quantity to the unit's, from the same repeats and seeds."""
    ones = {(row.case["repeat"], row.case["first"]): row.result[unit or quantity] for row in units}
    mine = {(row.case["repeat"], row.case["first"]): row.result[quantity] for row in rows}
    return [mine[place] / ones[place] for place in sorted(mine) if place in ones]


def tables(rows: Sequence[Row]) -> list[Table]:
    made = [(episode_table, "episodes"), (plan_table, "plans"), (cartpole_table, "cartpole")]
    return [make(found) for make, part in made if (found := grouped(rows, part))]


def episodes_of(rows: Sequence[Row]) -> dict[int, dict[int, list[Any]]]:
    """Episodes (seed, success, return, seconds) by set and seed; the seconds may be None."""
    sets: dict[int, dict[int, list[Any]]] = {}
    for row in rows:
        sets.setdefault(row.case["repeat"], {}).update({episode[0]: episode for episode in row.result["each"]})
    return sets


def mean_seconds(each: Sequence[Sequence[Any]]) -> float | None:
    """Mean time of the episodes that have one."""
    timed = [episode[3] for episode in each if episode[3] is not None]
    return statistics.fmean(timed) if timed else None


def cores_of(rows: Sequence[Row]) -> str:
    return ", ".join(map(str, sorted({row.case["threads"] for row in rows})))


def episode_table(found: dict[tuple[str, int | None], dict[str, list[Row]]]) -> Table:
    lines = []
    for (task, _), same in found.items():
        for name, group in same.items():
            sets = episodes_of(group)
            each = [episode for same_set in sets.values() for episode in same_set.values()]
            good = sum(int(episode[1]) for episode in each)
            low, high = wilson(good, len(each))
            by_set = ", ".join(f"{i}: {sum(int(e[1]) for e in sets[i].values())}/{len(sets[i])}" for i in sorted(sets))
            times = []
            for i, ours in episodes_of(same.get("mppi", ())).items():
                both = [(sets[i][seed][3], ours[seed][3]) for seed in ours.keys() & sets.get(i, {}).keys()]
                if both := [pair for pair in both if None not in pair]:
                    times.append(sum(pair[0] for pair in both) / sum(pair[1] for pair in both))
            seconds = mean_seconds(each)
            lines.append([
                task, CONTESTANTS[name], cores_of(group), f"{good} of {len(each)}", f"{low:.0%} to {high:.0%}", by_set,
                "" if seconds is None else f"{seconds:.3g}", median_and_range(times),
            ])  # fmt: skip
    title = (
        "Episodes: success with its 95 % interval (Wilson), in each set of seeds, and mean seconds of those that were "
        "timed; where a planner controls a set at a time, those of the set divided by its episodes. The last column "
        "compares the same seeds, median over the sets (smallest to largest)."
    )
    header = ["task", "planner", "cores", "successes", "interval", "sets", "seconds", "seconds by ours"]
    return Table(title, header, lines)


def plan_table(found: dict[tuple[str, int | None], dict[str, list[Row]]]) -> Table:
    lines = []
    for (task, _), same in found.items():
        ours = same.get("mppi", [])
        for name, group in same.items():
            size = group[0].result
            bare = [row.result["bare_ms"] for row in group if "bare_ms" in row.result]
            kept = [row.result["kept"] for row in group if "kept" in row.result]
            lines.append([
                task, f"{size['samples']} x {size['horizon']}", CONTESTANTS[name],
                median_and_range([row.result["plan_ms"] for row in group], ".4g"), median_and_range(bare, ".4g"),
                median_and_range(kept, ".1%"),
                median_and_range(ratios(group, ours, "plan_ms")),
                median_and_range(ratios(group, ours, "plan_ms", "bare_ms")),
            ])  # fmt: skip
    title = (
        "A plan: medians over the repeats (smallest to largest). The bare engine makes the same rollouts. What is kept "
        "is its time by that of the plan, and so the share of its advantage over Python that is left."
    )
    header = ["task", "samples x horizon", "planner", "plan, ms", "bare engine, ms", "kept", "by our plan",
              "by the bare C engine"]  # fmt: skip
    return Table(title, header, lines)


def cartpole_table(found: dict[tuple[str, int | None], dict[str, list[Row]]]) -> Table:
    lines = []
    for (_, samples), same in found.items():
        for name, group in same.items():
            returns = [value for row in group for value in row.result["returns"]]
            mean, half = comparison.mean_interval(returns)
            lines.append([
                str(samples), CONTESTANTS[name], median_and_range([row.result["plan_ms"] for row in group], ".3g"),
                median_and_range(ratios(group, same.get("mppi", ()), "plan_ms")),
                f"{mean:.0f} ± {half:.0f}", str(len(returns)),
            ])  # fmt: skip
    steps = next(iter(next(iter(found.values())).values()))[0].case["steps"]
    title = (
        f"Cartpole's swing-up, {SWINGUP['horizon']} steps of one substep, {KNOTS} knots with linear interpolation, "
        f"noise {SWINGUP['noise']}, temperature {SWINGUP['temperature']}: time of a plan, and return of {steps} steps "
        "(mean ± half of its 95 % interval)."
    )
    return Table(title, ["samples", "planner", "plan, ms", "by ours", "return", "episodes"], lines)


def figure(rows: Sequence[Row]) -> Figure | None:
    """Seconds of an episode with its success, or milliseconds of a plan, as points on a logarithmic axis.

    None where no two planners can be compared.
    """
    panels: list[tuple[str, str, list[tuple[str, float, str]]]] = []  # title, unit, contestants
    for (task, _), same in grouped(rows, "episodes").items():
        points, every = [], [row for group in same.values() for row in group]
        for name, group in same.items():
            each = [episode for row in group for episode in row.result["each"]]
            good = sum(int(episode[1]) for episode in each)
            if (seconds := mean_seconds(each)) is not None:
                points.append((name, seconds, f"{seconds:.3g} s, {good} of {len(each)} succeed"))
        if len(points) > 1:
            panels.append((task, f"seconds of an episode, cores: {cores_of(every)}", points))
    for part in ("plans", "cartpole"):
        for (task, samples), same in grouped(rows, part).items():
            points = []
            for name, group in same.items():
                plan = statistics.median(row.result["plan_ms"] for row in group)
                text = f"{plan:,.0f} ms" if plan >= 100.0 else f"{plan:.3g} ms"
                if part == "cartpole":
                    text += f", return {statistics.fmean(row.result['return'] for row in group):.0f}"
                points.append((name, plan, text))
            if len(points) > 1:
                title = task if samples is None else f"{task}, {samples} samples"
                panels.append((title, "milliseconds of a plan", points))
    if not panels:
        return None
    drawn = Figure(figsize=(11.0, 1.0 + 1.9 * ((len(panels) + 1) // 2)), layout="constrained")
    FigureCanvasAgg(drawn)
    axes = drawn.subplots((len(panels) + 1) // 2, 2, squeeze=False).flatten()
    for panel, (task, unit, points) in zip(axes, panels, strict=False):
        panel.set_title(task, loc="left", fontsize=10)
        panel.set_xlabel(unit)
        panel.set_xscale("log")
        names, values, texts = zip(*points, strict=True)
        places = np.arange(len(points))[::-1]
        panel.scatter(values, places, s=60, color=[COLORS[name] for name in names], zorder=2)
        panel.set_yticks(places, [CONTESTANTS[name] for name in names])
        panel.set_ylim(-0.7, len(points) - 0.3)
        left, right = min(values) / 2, max(values)
        panel.set_xlim(left, max(right * 20, left * (right / left) ** 2.3))  # room for the text beside the last point
        panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
        for place, value, text in zip(places, values, texts, strict=True):
            panel.annotate(text, (value, place), xytext=(8, 0), textcoords="offset points", va="center", fontsize=8)
    for panel in axes[len(panels) :]:
        panel.set_visible(False)
    finish_axes(axes)
    return drawn


EXPERIMENT = experiment.Experiment(
    name="mppi", summary="MPPI in episodes and in planning time, beside Python, bare engines and judo",
    cases=cases, estimate=estimate, measure=measure, tables=tables, figure=figure, options=Options,
    packages=("gymnasium-robotics",), parallel=True,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
