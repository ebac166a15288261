"""What it costs to draw the model's fields for every world and every episode.

    python bench/dynamics.py --nworld 256

Environments of the same task take turns of twenty steps: one without draws, one that draws frictions, the actuators'
gains and the joints' damping at every reset, and one that draws masses, from which constants of the model follow. The
draws are so narrow that the physics stays the same. The ratio of each pair of turns is taken, and the median over all
pairs printed, with the time of the steps in which episodes begin. Half_cheetah's episodes last 1,000 steps and are
staggered; hopper's end when it falls, under random actions after some twenty steps.
"""

import dataclasses
import statistics
import time
from pathlib import Path

import measurements
import torch
import tyro
import warp as wp
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw
from lyceum_warp import Row

STEPS = 20


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    geom_friction: Row[wp.vec3]
    actuator_gainprm: Row[lw.vec10]
    dof_damping: Row[float]
    body_mass: Row[float]


@wp.struct
class Params:
    dt: float
    lowest: float = -wp.inf  # of the coordinate 1, the height of hopper; below it an episode ends
    spread: float = 1e-5  # half the range of the factor on each nominal value


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    n = s.qpos.shape[0] - 1
    for i in range(n):
        obs[i] = s.qpos[i + 1]
        obs[n + i] = s.qvel[i + 1]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return (s1.qpos[0] - s0.qpos[0]) / p.dt


@wp.func
def terminated(s: World, p: Params) -> bool:
    return s.qpos[1] < p.lowest


@wp.func
def start(s: World, rng: Row[wp.uint32]):
    for i in range(s.qpos.shape[0]):
        s.qpos[i] += lw.uniform(rng, -5e-3, 5e-3)
        s.qvel[i] += lw.uniform(rng, -5e-3, 5e-3)


@wp.func
def factor(p: Params, rng: Row[wp.uint32]) -> float:
    return 1.0 + lw.uniform(rng, -p.spread, p.spread)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    start(s, rng)


@wp.func
def randomize_gains(s: World, p: Params, rng: Row[wp.uint32]):
    start(s, rng)
    for i in range(s.geom_friction.shape[0]):
        s.geom_friction[i] = s.geom_friction[i] * factor(p, rng)
    for i in range(s.actuator_gainprm.shape[0]):
        s.actuator_gainprm[i] = s.actuator_gainprm[i] * factor(p, rng)
    for i in range(s.dof_damping.shape[0]):
        s.dof_damping[i] = s.dof_damping[i] * factor(p, rng)


@wp.func
def randomize_masses(s: World, p: Params, rng: Row[wp.uint32]):
    start(s, rng)
    for i in range(s.body_mass.shape[0]):
        s.body_mass[i] = s.body_mass[i] * factor(p, rng)


class Cheetah(lw.Task):
    """Half_cheetah without draws of the model."""

    model, frame_skip, horizon = "half_cheetah.xml", 5, 1000
    obs = {"position": 8, "velocity": 8}


class CheetahGains(Cheetah):
    """With frictions, gains and damping that differ between episodes."""

    randomize = randomize_gains


class CheetahMasses(Cheetah):
    """With masses that differ between episodes."""

    randomize = randomize_masses


class Hopper(Cheetah):
    """Hopper without draws of the model."""

    model, frame_skip = "hopper.xml", 4
    obs = {"position": 5, "velocity": 5}


class HopperGains(Hopper):
    """With frictions, gains and damping that differ between episodes."""

    randomize = randomize_gains


class HopperMasses(Hopper):
    """With masses that differ between episodes."""

    randomize = randomize_masses


CASES = {"half_cheetah": (Cheetah, CheetahGains, CheetahMasses), "hopper": (Hopper, HopperGains, HopperMasses)}


@dataclasses.dataclass(frozen=True)
class Options:
    """The cost of drawing model fields, as a table and as JSON."""

    tasks: tuple[str, ...] = tuple(CASES)
    """half_cheetah, hopper."""
    nworld: tuple[int, ...] = (256,)
    """Numbers of worlds."""
    device: str = "cpu"
    """Device."""
    engine: str = "auto"
    """Engine."""
    pairs: int = 20
    """Pairs of turns."""
    out: Path | None = None
    """JSON file for the results."""


@dataclasses.dataclass(frozen=True)
class Cost:
    """One task with one kind of draws."""

    task: str
    draws: str
    engine: str
    device: str
    nworld: int
    step_ms: float
    """A step without draws, median over the turns."""
    ratio: float
    """Time of a step with draws by that of a step without, median over the pairs."""
    restarts_per_step: float
    """Share of the worlds that begin an episode in a step."""


def turn(env: lw.Env, actions: torch.Tensor) -> float:
    """Seconds of some steps."""
    wp.synchronize_device(env.device)
    start = time.perf_counter()
    for action in actions:
        env.action.copy_(action)
        env.step()
    wp.synchronize_device(env.device)
    return time.perf_counter() - start


def made(task: type[lw.Task], options: Options, nworld: int) -> lw.Env:
    """An environment whose episodes are staggered."""
    params = {"lowest": 0.7} if issubclass(task, Hopper) else {}
    env = lw.make(task, nworld=nworld, device=options.device, engine=options.engine, **params)
    state = env.get_state()
    generator = torch.Generator().manual_seed(0)
    steps = torch.randint(env.horizon, (nworld, 1), generator=generator)
    state[:, env.state_space.parts["step"]] = steps.to(state)
    env.set_state(state)
    return env


def costs_of(name: str, options: Options, nworld: int) -> list[Cost]:
    """Costs of one task's draws."""
    envs = [made(task, options, nworld) for task in CASES[name]]
    generator = torch.Generator().manual_seed(1)
    shape = STEPS, *envs[0].action.shape
    seconds: list[list[float]] = [[] for _ in envs]
    restarts = 0.0
    for pair in range(options.pairs + 2):  # the first two load kernels and settle the motion
        actions = (2 * torch.rand(shape, generator=generator) - 1).to(envs[0].action)
        for env, times in zip(envs, seconds, strict=True):
            times.append(turn(env, actions))
        restarts = float((envs[0].episode_step < STEPS).float().mean()) / STEPS
        if pair == 1:
            seconds = [[] for _ in envs]
    plain, *drawn = seconds
    return [
        Cost(
            name,
            draws,
            envs[0].engine.name,
            options.device,
            nworld,
            1e3 * statistics.median(plain) / STEPS,
            statistics.median(b / a for a, b in zip(plain, times, strict=True)),
            restarts,
        )
        for draws, times in zip(("friction, gains, damping", "masses"), drawn, strict=True)
    ]


def main(options: Options) -> None:
    """Measure and print."""
    costs = [cost for name in options.tasks for n in options.nworld for cost in costs_of(name, options, n)]
    table = Table("task", "draws", "engine", "worlds", "step without", "time with draws", "restarts a step")
    for cost in costs:
        table.add_row(cost.task, cost.draws, cost.engine, str(cost.nworld), f"{cost.step_ms:.3f} ms",
                      f"{100 * cost.ratio:.2f} %", f"{100 * cost.restarts_per_step:.2f} %")  # fmt: skip
    Console().print(table)
    if options.out is not None:
        measurements.write(options.out, costs, options.device)


if __name__ == "__main__":
    main(tyro.cli(Options))
