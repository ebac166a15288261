"""Fidelity: how long trajectories of the two engines stay together, and what the same policy earns on each.

    lyceum-warp bench fidelity --device cuda --jobs 4
    lyceum-warp bench fidelity --tasks hopper --policy runs/hopper-20260101-120000

Divergence. Worlds of both engines begin in the same states, every number one of float32, and get the same actions. The
C engine (float64) is the reference of three others: the Warp engine (float32), the C engine with its state rounded to
float32 after every step, and the C engine whose positions and velocities were moved once, at the start, by at most the
rounding of a float32 number. Those two are the unit: an engine is as faithful as its precision allows where its
trajectories stay with the reference for as long as theirs do. The differences of a world are its largest ones, of
observations and rewards relative to the larger of 1 and the number, of positions absolute. Contact forces in
observations, which a solver finds only to its tolerance, are left out. Worlds go on after the end of their episode, and
leave the comparison after a fault.

With pyramidal friction cones, MuJoCo Warp chooses other tangents than MuJoCo where a capsule lies on a plane. Such
tasks are compared with elliptic cones, too, which do not depend on the tangents.

Policies. Zero actions, random ones, those of a policy that NPG trained for a while on the C engine (with the case's
cones), or those of a run. Trajectories get the actions that the policy takes in the C engine's worlds.

Returns. Each engine runs whole episodes of the policy from the same states with the same random streams. The difference
of an episode's returns is paired; intervals are 95 % percentile intervals of a bootstrap over the episodes. The
episodes from the moved states say how far returns differ by chance.
"""

import dataclasses
import functools
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import experiment
import numpy as np
import torch
from experiment import Experiment, Row, Skipped, Table
from matplotlib.figure import Figure

import lyceum_warp as lw
from lyceum_warp.binding.registry import find_task
from lyceum_warp.done import FAULTS
from lyceum_warp.runs.folder import Run
from lyceum_warp.spaces import COUNTERS
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.support.validate import positive_number, whole_number
from lyceum_warp.viz.style import ACCENT, LINE, finish_axes, new_figure

ZERO, RANDOM, TRAINED = "zero", "random", "trained"
OWN, ELLIPTIC = "own", "elliptic"

CAPSULES_ON_A_PLANE = ("ant", "half_cheetah", "hopper", "humanoid", "humanoid_standup", "walker2d")
"""Tasks with pyramidal cones whose capsules lie on a plane."""

LEARNT = (
    "ant", "cartpole", "cartpole_swingup", "half_cheetah", "hopper", "humanoid", "inverted_double_pendulum",
    "inverted_pendulum", "point_mass", "pusher", "reach", "reacher", "swimmer", "walker2d",
)  # fmt: skip
"""Tasks that NPG makes progress in within a few iterations."""

STEPS = (1, 2, 3, 5, 7, 10, 14, 20, 30, 50, 70, 100, 140, 200, 300, 500, 700, 1000)
"""Steps at which differences are kept."""

SETTLING = 20
"""Steps of the policy that lead to the states at the start of the trajectories, so that there are contacts."""

ROUNDING = 2.0**-24
"""Largest relative error of a number that is rounded to float32."""

FORCES = ("contact_force",)
"""Parts of observations that are left out."""

PAIRS = {"engines": "Warp engine", "rounded": "C engine, state rounded to float32", "moved": "C engine, start moved"}
"""What is compared with the C engine."""

COST = {
    "adroit_door": (500, 3500), "adroit_hammer": (650, 5000), "adroit_pen": (400, 1900),
    "adroit_relocate": (400, 2600), "aloha_lift": (700, 3000), "ant": (180, 700), "arm_hand_pickup": (200, 550),
    "cartpole": (15, 25), "cartpole_swingup": (15, 25), "go1_velocity": (500, 2500), "half_cheetah": (40, 200),
    "herb_reach": (700, 6000), "hopper": (40, 200), "humanoid": (200, 1300), "humanoid_standup": (250, 1700),
    "inverted_double_pendulum": (30, 200), "inverted_pendulum": (15, 80), "panda_lift": (300, 750),
    "point_mass": (10, 20), "pusher": (30, 150), "reach": (30, 50), "reacher": (20, 100), "soft_ball": (500, 3000),
    "swimmer": (30, 200), "walker2d": (60, 300),
}  # fmt: skip
"""Microseconds of a world's step: C engine on two cores, Warp engine on one."""

NPG_SAMPLES = 10_000
"""Samples in an iteration of NPG."""

GPU_STEP = 5e-3
"""Seconds of a step of all worlds on a GPU."""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    """Agreement of the engines."""

    policy: Path | None = None
    """Folder of a run, whose mean policy acts in its task, too."""
    steps: int = 1000
    """Steps over which trajectories are compared, at most those of an episode."""
    nworld: int = 128
    """Worlds, and episodes of a policy."""
    iterations: int = 30
    """NPG's iterations of 10,000 samples for the trained policies; 0 for no such policies."""
    tolerance: float = 0.01
    """Difference of observations from which on two trajectories count as apart."""


@dataclasses.dataclass(frozen=True)
class Case:
    """Trajectories and episodes of one policy in one task."""

    task: str
    policy: str
    """zero, random, trained, or the folder of a run."""
    cone: str
    nworld: int
    steps: int
    """Of the trajectories."""
    tolerance: float
    iterations: int
    device: str
    seed: int


def cases(options: Options) -> list[Case]:
    tasks = experiment.choose(options.tasks, lw.task_names(), ("hopper",) if options.short else (), what="task")
    own = {} if options.policy is None else {Run.open(options.policy).task_name: str(options.policy)}
    if own.keys() - set(tasks):
        raise ValueError(f"the policy of {options.policy} acts in {next(iter(own))}, which is not among the tasks")
    nworld, steps = (whole_number(f"--{name}", getattr(options, name), low=1) for name in ("nworld", "steps"))
    iterations = whole_number("--iterations", options.iterations, low=0)
    positive_number("--tolerance", options.tolerance, "of observations")
    if options.short:
        nworld, steps, iterations = min(nworld, 8), min(steps, 20), 0
    found: list[Case] = []
    for seed in options.seeds or (0,):
        for task in tasks:
            learnt = [TRAINED] * (iterations > 0 and task in LEARNT) + [name for of, name in own.items() if of == task]
            variants = [(policy, OWN) for policy in (ZERO, RANDOM, *learnt)]
            if task in CAPSULES_ON_A_PLANE and not options.short:
                variants += [(policy, ELLIPTIC) for policy in (RANDOM, *learnt)]
            found += [
                Case(task, policy, cone, nworld, steps, options.tolerance, iterations if policy == TRAINED else 0,
                     options.device, seed)
                for policy, cone in variants
            ]  # fmt: skip
    return found


def estimate(case: Case) -> float:
    """Seconds, without the compilation of a task's kernels."""
    c, warp = COST.get(case.task, (200.0, 1000.0))
    c *= 2e-6 / min(8, cpu_cores())  # more cores gain less, or are shared by jobs
    warp_step = GPU_STEP if case.device.startswith("cuda") else 1e-6 * warp * case.nworld
    # the trajectories of the C engine's three sets of worlds, with their states, and two sets of episodes
    steps, episodes = episode_steps(case.task, case.steps), episode_steps(case.task, 1000)
    c_steps = case.nworld * (3.5 * steps + 2.0 * episodes)
    return 10.0 + (steps + episodes) * warp_step + c * c_steps + case.iterations * (0.3 + c * NPG_SAMPLES)


def episode_steps(task: str, most: int) -> int:
    """The steps of a task's episode, or a number if that is smaller."""
    return min(most, find_task(task).horizon or most)


# worlds and policies


def make(case: Case, options: Options, **words: Any) -> lw.Env:
    """Worlds of the case's task, on the C engine if nothing else is said.

    Raises:
        Skipped: The package that brings the task's model is not installed.
    """
    words = {"engine": "mujoco", "seed": case.seed} | words
    if words["engine"] == "mujoco":
        words["nthread"] = options.threads
    if case.cone != OWN:
        words["cone"] = case.cone
    try:
        return lw.make(case.task, **words)
    except (FileNotFoundError, ImportError) as error:
        raise Skipped(f"{case.task}: {error}") from error


Policy = Callable[[torch.Tensor], torch.Tensor]


def policy_of(case: Case, env: lw.Env, options: Options) -> Policy:
    """What acts: called with observations on the CPU, (nworld, nobs), returns actions, (nworld, nact), there.

    Random actions are those of a stream that begins here, so that equal calls get equal ones.
    """
    if case.policy == ZERO:
        return lambda obs: torch.zeros(len(obs), env.action_space.size)
    if case.policy == RANDOM:
        low, high = bounds(env)
        generator = torch.Generator().manual_seed(case.seed)
        return lambda obs: low + (high - low) * torch.rand(len(obs), len(low), generator=generator)
    return trained(case, options) if case.policy == TRAINED else lw.load(case.policy)


def bounds(env: lw.Env) -> tuple[torch.Tensor, torch.Tensor]:
    """Least and greatest actions; -1 and 1 where there are no bounds."""
    space = env.action_space
    low = np.full(space.shape, -np.inf) if space.low is None else space.low
    high = np.full(space.shape, np.inf) if space.high is None else space.high
    finite = np.nan_to_num(low, neginf=-1.0), np.nan_to_num(high, posinf=1.0)
    return torch.from_numpy(finite[0]).float(), torch.from_numpy(finite[1]).float()


@functools.lru_cache(maxsize=1)
def trained(case: Case, options: Options) -> lw.GaussianPolicy:
    """A policy after some iterations of NPG on the C engine."""
    with torch.enable_grad():
        learner = lw.NPG(make(case, options, nworld=64), config=lw.NPGConfig(samples=NPG_SAMPLES), seed=case.seed)
        for _ in range(case.iterations):
            next(learner)
    return learner.policy.requires_grad_(False)


def start(env: lw.Env, policy: Policy, seed: int, steps: int) -> torch.Tensor:
    """States after some steps from random initial ones, rounded to float32 (counters excepted)."""
    env.rand_reset(seed)
    for _ in range(steps):
        env.step(policy(env.obs))
    return rounded(env, env.get_state())


def rounded(env: lw.Env, state: torch.Tensor) -> torch.Tensor:
    """States with every number, counters excepted, one of float32."""
    near = state.float().double()
    for name in COUNTERS:
        if (part := env.state_space.parts.get(name)) is not None:
            near[:, part] = state[:, part]
    return near


def moved(env: lw.Env, state: torch.Tensor, seed: int) -> torch.Tensor:
    """States with positions and velocities moved by at most the rounding of float32, of 1 or of the number."""
    generator, near = torch.Generator().manual_seed(seed), state.clone()
    for name in ("qpos", "qvel"):
        values = near[:, env.state_space.parts[name]]
        draws = 2.0 * torch.rand(values.shape, generator=generator, dtype=torch.float64) - 1.0
        values += ROUNDING * draws * values.abs().clamp(min=1.0)
    return near


def faulty(env: lw.Env) -> torch.Tensor:
    return (env.done_reason & int(FAULTS) != 0).cpu()


def step(env: lw.Env, action: torch.Tensor) -> float:
    """One step; returns its seconds, up to the moment at which observations are on the CPU."""
    began = time.perf_counter()
    env.step(action.to(env.action.device))
    env.obs.cpu()
    return time.perf_counter() - began


# divergence


def divergence(case: Case, options: Options) -> dict[str, Any]:
    first = make(case, options, nworld=case.nworld)
    actor = policy_of(case, first, options)
    state = start(first, actor, case.seed, SETTLING)
    steps = episode_steps(case.task, case.steps)
    c = first.replicate(autoreset=False, horizon=0)
    endless = {"nworld": case.nworld, "autoreset": False, "horizon": 0}
    others = {
        "engines": make(case, options, engine="warp", device=case.device, **endless),
        "rounded": c.replicate(),
        "moved": c.replicate(),
    }
    for env in (c, *others.values()):  # captures graphs outside the clock
        for _ in range(3):
            env.step()
    c.set_state(state)
    for name, env in others.items():
        given = moved(env, state, case.seed) if name == "moved" else state
        env.set_state(given.to(env.obs.device))
    compared = torch.ones(c.obs_space.size, dtype=torch.bool)
    for name in FORCES:
        if (part := c.obs_space.parts.get(name)) is not None:
            compared[part] = False
    qpos = c.state_space.parts["qpos"]
    quantities = ("obs", "reward", "qpos")
    errors = {name: {what: torch.full((steps, case.nworld), torch.nan) for what in quantities} for name in others}
    good = {name: torch.ones(case.nworld, dtype=torch.bool) for name in others}
    ends = {name: torch.full((case.nworld,), steps) for name in ("c", *others)}
    seconds = dict.fromkeys(("c", *others), 0.0)
    bad = torch.zeros(case.nworld, dtype=torch.bool)
    for t in range(steps):
        action = actor(c.obs)
        seconds["c"] += step(c, action)
        bad |= faulty(c)
        mark_ends(ends["c"], c, t)
        positions = c.get_state()[:, qpos]
        for name, env in others.items():
            seconds[name] += step(env, action)
            good[name] &= ~faulty(env) & ~bad
            mark_ends(ends[name], env, t)
            after = env.get_state()
            found = {
                "obs": relative(env.obs.cpu(), c.obs)[:, compared].amax(1),
                "reward": relative(env.reward.cpu(), c.reward),
                "qpos": (after[:, qpos].cpu() - positions).abs().amax(1),
            }
            for what, error in found.items():
                errors[name][what][t] = error.masked_fill(~good[name], torch.nan)
            if name == "rounded":
                env.set_state(rounded(env, after), check=False)
    kept = [t for t in (*(t for t in STEPS if t < steps), steps)]
    pairs = {
        name: {
            **{what: quantiles(error, kept) for what, error in errors[name].items()},
            **apart(errors[name]["obs"], good[name], case.tolerance),
            "same_end": mean(ends[name][good[name]] == ends["c"][good[name]]),
            "faults": int((~good[name]).sum()),
        }
        for name in others
    }
    each = 1e6 / (steps * case.nworld)
    return {
        "steps": kept, "pairs": pairs,
        "c_us": seconds["c"] * each, "warp_us": seconds["engines"] * each,
    }  # fmt: skip


def relative(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Difference, relative to the larger of 1 and the second number."""
    return (a - b).abs() / b.abs().clamp(min=1.0)


def mark_ends(ends: torch.Tensor, env: lw.Env, t: int) -> None:
    """Write down the step of worlds that terminate for the first time."""
    over = env.terminated.cpu()
    ends[over] = ends[over].clamp(max=t)


def quantiles(error: torch.Tensor, kept: Sequence[int]) -> dict[str, list[float | None]]:
    """Median and 99 % quantile over worlds, after some numbers of steps."""
    rows = error[[t - 1 for t in kept]].double()
    found = {name: rows.nanquantile(q, dim=1).tolist() for name, q in (("median", 0.5), ("p99", 0.99))}
    return {name: [value if math.isfinite(value) else None for value in values] for name, values in found.items()}


def apart(error: torch.Tensor, good: torch.Tensor, tolerance: float) -> dict[str, Any]:
    """After how many steps a tenth and half of the worlds are apart (None: they are together at the end)."""
    beyond = error[:, good] > tolerance
    never = len(error) + 1
    first = torch.where(beyond.any(0), beyond.int().argmax(0) + 1, never).sort().values
    found: dict[str, Any] = {}
    for name, share in (("tenth_apart", 0.1), ("half_apart", 0.5)):
        at = int(first[math.ceil(share * len(first)) - 1]) if len(first) else never
        found[name] = None if at == never else at
    return found | {"together": mean(first == never)}


def mean(flags: torch.Tensor) -> float | None:
    """Share of the flags that are set; None without flags."""
    return flags.double().mean().item() if len(flags) else None


# returns


def returns(case: Case, options: Options) -> dict[str, Any] | None:
    """None where the task has no horizon, so that an episode may never end, or where every episode has a fault."""
    c = make(case, options, nworld=case.nworld, autoreset=False)
    if c.horizon == 0:
        return None
    c.rand_reset(case.seed)
    state = rounded(c, c.get_state())
    warp = make(case, options, engine="warp", device=case.device, nworld=case.nworld, autoreset=False)
    found: dict[str, Episodes] = {}
    for name, env, given in (("c", c, state), ("moved", c, moved(c, state, case.seed)), ("warp", warp, state)):
        env.set_state(given.to(env.obs.device))
        found[name] = episodes(env, policy_of(case, c, options))
    good = ~(found["c"].fault | found["moved"].fault | found["warp"].fault)
    if not good.any():
        return None
    values = {name: of.returns[good].numpy() for name, of in found.items()}
    lengths = {name: of.lengths[good].double().mean().item() for name, of in found.items()}
    success = {name: of.success[good].double().mean().item() for name, of in found.items()}
    named = {name: interval(value, case.seed) for name, value in values.items()}
    return {
        **named,
        "difference": interval(values["warp"] - values["c"], case.seed),
        "chance": interval(values["moved"] - values["c"], case.seed),
        "std": float(values["c"].std(ddof=1)) if len(values["c"]) > 1 else None,
        "lengths": lengths,
        "success": success if c.task.functions["success"] is not None else None,
        "same_length": mean(found["warp"].lengths[good] == found["c"].lengths[good]),
        "same_length_by_chance": mean(found["moved"].lengths[good] == found["c"].lengths[good]),
        "episodes": int(good.sum()),
        "faults": int((~good).sum()),
    }


@dataclasses.dataclass
class Episodes:
    """An episode of each world, on the CPU."""

    returns: torch.Tensor
    lengths: torch.Tensor
    success: torch.Tensor
    """Whether the goal was met at the end."""
    fault: torch.Tensor


def episodes(env: lw.Env, policy: Policy) -> Episodes:
    """Run every world from its state to the end of its episode."""
    nworld = env.nworld
    total, success = torch.zeros(nworld, dtype=torch.float64), torch.zeros(nworld, dtype=torch.bool)
    lengths, fault = torch.zeros(nworld, dtype=torch.long), torch.zeros(nworld, dtype=torch.bool)
    running = torch.ones(nworld, dtype=torch.bool)
    while running.any():
        env.step(policy(env.obs.cpu()).to(env.action.device))
        total += torch.where(running, env.reward.cpu().double(), 0.0)
        lengths += running
        fault |= running & faulty(env)
        over = running & env.done.cpu()
        success |= over & env.success.cpu()
        running &= ~over
    return Episodes(total, lengths, success, fault)


def interval(values: np.ndarray, seed: int, draws: int = 10_000) -> list[float]:
    """Mean, and the limits of its 95 % percentile interval from a bootstrap over the values."""
    random = np.random.default_rng(seed)
    means = values[random.integers(0, len(values), (draws, len(values)))].mean(axis=1)
    return [float(values.mean()), *(float(q) for q in np.quantile(means, (0.025, 0.975)))]


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    with torch.no_grad():
        return divergence(case, options) | {"returns": returns(case, options)}


# tables and figure


def ordered(rows: Sequence[Row]) -> list[Row]:
    """Rows by task, cone and policy; jobs finish in any order."""
    policies = {name: place for place, name in enumerate((ZERO, RANDOM, TRAINED))}
    return sorted(
        rows, key=lambda row: (row.case["task"], row.case["cone"] != OWN, policies.get(row.case["policy"], 3))
    )


def tables(rows: Sequence[Row]) -> list[Table]:
    rows = ordered(rows)
    if not rows:
        return []
    return [
        Table(
            "Differences of observations from the C engine's: median and 99 % over worlds after some steps; steps "
            f"after which half of the worlds are apart by {rows[0].case['tolerance']:g}; episodes that end in the same "
            "step. *Rounded* and *moved* are the C engine itself, with its state rounded to float32 after every step, "
            "and with a start moved by the rounding of float32.",
            ("task", "policy", "cones", "1 step", "10", "100", "last", "half apart", "rounded", "moved", "same end",
             "faults"),
            [trajectory_cells(row) for row in rows],
        ),
        Table(
            "Mean returns of the same episodes on both engines, and means of the paired differences from the C engine "
            "with 95 % intervals (bootstrap): the Warp engine's, and the C engine's from moved states. The standard "
            "deviation is that of the C engine's episodes.",
            ("task", "policy", "cones", "episodes", "C engine", "standard deviation", "Warp engine", "difference",
             "by chance"),
            [return_cells(row) for row in rows if row.result["returns"] is not None],
        ),
    ]  # fmt: skip


def first_cells(row: Row) -> list[str]:
    """Task, policy and cones."""
    return [row.case["task"], actor_name(row.case["policy"]), row.case["cone"]]


def trajectory_cells(row: Row) -> list[str]:
    engines, steps, at = row.result["pairs"]["engines"], row.result["steps"], []
    for wanted in (1, 10, 100, steps[-1]):
        pair = [engines["obs"][name][steps.index(wanted)] if wanted in steps else None for name in ("median", "p99")]
        at.append("" if None in pair else ", ".join(f"{value:.0e}" if value else "0" for value in pair))
    half = [row.result["pairs"][name]["half_apart"] for name in PAIRS]
    return [
        *first_cells(row), *at, *(str(value) if value else f"> {steps[-1]}" for value in half),
        "" if engines["same_end"] is None else f"{engines['same_end']:.0%}", str(engines["faults"]),
    ]  # fmt: skip


def return_cells(row: Row) -> list[str]:
    result = row.result["returns"]
    spread = [
        f"{result[name][0]:+.3g} ({result[name][1]:+.3g} to {result[name][2]:+.3g})"
        for name in ("difference", "chance")
    ]
    std = "" if result["std"] is None else f"{result['std']:.3g}"
    means = [f"{result[name][0]:.5g}" for name in ("c", "warp")]
    return [*first_cells(row), str(result["episodes"]), means[0], std, means[1], *spread]


def actor_name(name: str) -> str:
    """A policy's name, or the last part of the path of its run."""
    return Path(name).name


def figure(rows: Sequence[Row]) -> Figure:
    """Differences of observations under random actions over the steps, one panel a task.

    Lines are medians, one also the engines' 99 % quantile.
    """
    rows = [row for row in ordered(rows) if row.case["policy"] == RANDOM]
    if not rows:
        raise ValueError("the results have no trajectories under random actions to draw")
    tasks = list(dict.fromkeys(row.case["task"] for row in rows))
    across = min(5, len(tasks))
    down = -(-len(tasks) // across)
    drawn: Figure = new_figure("divergence", max(5.0, 2.9 * across), 2.3 * down + 0.8)
    panels = drawn.subplots(down, across, squeeze=False, sharex=True, sharey=True).flatten()
    lines: dict[str, Any] = {}
    for task, axes in zip(tasks, panels, strict=False):
        for row in (row for row in rows if row.case["task"] == task):
            lines |= draw(axes, row)
        axes.axhline(rows[0].case["tolerance"], color="#9aa0a6", linewidth=0.8, linestyle=":")
        axes.set_title(task, loc="left", fontsize=9)
        axes.set(xscale="log", yscale="log", ylim=(2e-9, 30.0))
    for axes in panels[len(tasks) :]:
        axes.set_visible(False)
    for axes in panels[max(0, len(tasks) - across) : len(tasks)]:
        axes.set_xlabel("step")
        axes.tick_params(labelbottom=True)
    for axes in panels[::across]:
        axes.set_ylabel("difference of observations")
    finish_axes(panels[: len(tasks)])
    drawn.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=min(len(lines), 2 + across // 2),
                 frameon=False, fontsize=8)  # fmt: skip
    return drawn


COLORS = {"engines": ACCENT, "rounded": LINE, "moved": "#3d6fa5"}


def draw(axes: Any, row: Row) -> dict[str, Any]:
    """Draw a row; returns its lines by their labels."""
    found, steps = {}, row.result["steps"]

    def line(pair: str, which: str, label: str, **style: Any) -> None:
        values = row.result["pairs"][pair]["obs"][which]
        # 0 has no place on the axis: equal numbers stand at its lower end
        heights = [math.nan if value is None else max(value, 3e-9) for value in values]
        found[label] = axes.plot(steps, heights, color=COLORS[pair], **style)[0]

    if row.case["cone"] == ELLIPTIC:
        line("engines", "median", f"{PAIRS['engines']}, elliptic cones", linestyle="--", linewidth=1.2)
        return found
    line("engines", "median", f"{PAIRS['engines']}, median", linewidth=1.6)
    line("engines", "p99", f"{PAIRS['engines']}, 99 %", linewidth=0.8, alpha=0.6)
    line("rounded", "median", PAIRS["rounded"], linewidth=1.1)
    line("moved", "median", PAIRS["moved"], linewidth=1.1)
    return found


EXPERIMENT = Experiment(
    name="fidelity",
    summary="agreement of the engines: divergence of trajectories, returns of the same policy",
    cases=cases, estimate=estimate, measure=measure, tables=tables, figure=figure, options=Options,
    parallel=True,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
