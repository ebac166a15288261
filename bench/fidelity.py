"""Measure the number of steps after which trajectories of the two engines diverge.

    lyceum-warp bench fidelity --device cuda --jobs 4

Worlds of both engines start in the same float32 states and get the same random actions. The C engine (float64) is
compared with the Warp engine (float32). Because of chaos, rounding errors alone make two trajectories diverge. Two more
simulations on the C engine show how fast. One rounds its state to float32 after every step. The other starts from a
state with added noise of the size of a rounding error.

Two states are compared by their observations without contact forces, relative to max(1, |value|).
"""

import dataclasses
import math
import sys
from collections.abc import Sequence
from typing import Any

import contestants
import experiment
import torch
from experiment import Experiment, Row, Skipped, Table

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.core import COUNTERS, FAULTS
from lyceum_warp.support.validate import whole_number

SHOWN = (1, 10, 100)
"""Steps at which differences are stored. The last step is stored, too."""

SETTLING = 20
"""Number of steps before the trajectories start. Robots touch the ground in these steps."""

ROUNDING = 2.0**-24

APART = 0.01
"""Difference of observations above which two trajectories count as diverged."""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    steps: int = 1000
    """Number of compared steps; at most the length of an episode."""
    nworld: int = 128
    """Number of worlds."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    nworld: int
    steps: int
    device: str
    seed: int


def cases(options: Options) -> list[Case]:
    tasks = experiment.choose(options.tasks, lw.task_names(), ("hopper",) if options.short else (), what="task")
    nworld = whole_number("--nworld", options.nworld, low=1)
    steps = whole_number("--steps", options.steps, low=1)
    if options.short:
        nworld, steps = min(nworld, 8), min(steps, 20)
    return [
        Case(task, nworld, min(steps, find_task(task).horizon or steps), options.device, seed)
        for seed in options.seeds or (0,)
        for task in tasks
    ]


def rounded(env: lw.Env, state: torch.Tensor) -> torch.Tensor:
    near = state.float().double()
    for name in COUNTERS:
        if (part := env.state_space.parts.get(name)) is not None:
            near[:, part] = state[:, part]
    return near


def moved(env: lw.Env, state: torch.Tensor, seed: int) -> torch.Tensor:
    """Perturb each position and velocity x by at most ``ROUNDING`` * max(1, |x|)."""
    generator, near = torch.Generator().manual_seed(seed), state.clone()
    for name in ("qpos", "qvel"):
        values = near[:, env.state_space.parts[name]]
        draws = 2.0 * torch.rand(values.shape, generator=generator, dtype=torch.float64) - 1.0
        values += ROUNDING * draws * values.abs().clamp(min=1.0)
    return near


def faulty(env: lw.Env) -> torch.Tensor:
    return (env.done_reason & int(FAULTS) != 0).cpu()


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    worlds: dict[str, Any] = {"nworld": case.nworld, "seed": case.seed}
    endless = {"autoreset": False, "horizon": 0}
    try:
        first = lw.make(case.task, engine="mujoco", nthread=options.threads, **worlds)
        warp = lw.make(case.task, engine="warp", device=case.device, **worlds, **endless)
    except (FileNotFoundError, ImportError) as error:
        raise Skipped(f"{case.task}: {error}") from error
    actions = contestants.actions(first, case.seed)
    first.rand_reset(case.seed)
    for t in range(SETTLING):
        first.step(actions[t % len(actions)])
    state = rounded(first, first.get_state())
    c = first.replicate(**endless)
    simulations = {"engines": warp, "rounded": c.replicate(), "moved": c.replicate()}
    c.set_state(state)
    for name, env in simulations.items():
        env.set_state((moved(env, state, case.seed) if name == "moved" else state).to(env.obs.device))
    compared = torch.ones(c.obs_space.size, dtype=torch.bool)
    if (part := c.obs_space.parts.get("contact_force")) is not None:
        compared[part] = False
    errors = {name: torch.full((case.steps, case.nworld), torch.nan) for name in simulations}
    good = {name: torch.ones(case.nworld, dtype=torch.bool) for name in simulations}
    bad = torch.zeros(case.nworld, dtype=torch.bool)
    for t in range(case.steps):
        action = actions[(SETTLING + t) % len(actions)]
        c.step(action)
        bad |= faulty(c)
        for name, env in simulations.items():
            env.step(action.to(env.action.device))
            good[name] &= ~faulty(env) & ~bad
            gap = (env.obs.cpu() - c.obs).abs() / c.obs.abs().clamp(min=1.0)
            errors[name][t] = gap[:, compared].amax(1).masked_fill(~good[name], torch.nan)
            if name == "rounded":
                env.set_state(rounded(env, env.get_state()), check=False)
    stored_steps = [*(t for t in SHOWN if t < case.steps), case.steps]
    return {"steps": stored_steps, "pairs": {
        name: {
            "obs": quantiles(error, stored_steps),
            "half_apart": half_apart(error[:, good[name]]),
            "faults": int((~good[name]).sum()),
        }
        for name, error in errors.items()
    }}  # fmt: skip


def quantiles(error: torch.Tensor, steps: Sequence[int]) -> dict[str, list[float | None]]:
    """Return the median and the 99 % quantile of the worlds' differences at each of the given steps."""
    rows = error[[t - 1 for t in steps]].double()
    by_quantile = {name: rows.nanquantile(q, dim=1).tolist() for name, q in (("median", 0.5), ("p99", 0.99))}
    return {name: [value if math.isfinite(value) else None for value in values] for name, values in by_quantile.items()}


def half_apart(error: torch.Tensor) -> int | None:
    ever = (error > APART).cummax(0).values.double().mean(1) >= 0.5
    return int(ever.int().argmax()) + 1 if ever.any() else None


def tables(rows: Sequence[Row]) -> list[Table]:
    lines = []
    for row in sorted(rows, key=lambda row: row.case["task"]):
        pairs, steps = row.result["pairs"], row.result["steps"]
        at = []
        for step in (*SHOWN, steps[-1]):
            pair = [pairs["engines"]["obs"][q][steps.index(step)] if step in steps else None
                    for q in ("median", "p99")]  # fmt: skip
            at.append("" if None in pair else ", ".join(f"{value:.0e}" if value else "0" for value in pair))
        half = [str(pairs[name]["half_apart"] or f"> {steps[-1]}") for name in ("engines", "rounded", "moved")]
        lines.append([row.case["task"], str(row.case["nworld"]), *at, *half, str(pairs["engines"]["faults"])])
    title = (
        "Differences between the engines' observations under random actions: median and 99 % quantile over the worlds "
        "after some steps. The columns from 'half apart' to 'moved' compare other simulations with the C engine. They "
        f"give the first step by which half of the worlds have differed by more than {APART:g}. 'Warp' is the Warp "
        "engine. 'rounded' is a C engine that rounds its state to float32 after every step. 'moved' is a C engine that "
        "starts with added noise of the size of a rounding error."
    )
    header = ["task", "worlds", "1 step", "10", "100", "last", "half apart: Warp", "rounded", "moved", "faults"]
    return [Table(title, header, lines)]


EXPERIMENT = Experiment(
    name="fidelity", conditions="Both engines step tasks with exact physics.",
    summary="Agreement of the engines: divergence of trajectories under random actions.",
    cases=cases, estimate=lambda case: 10.0 + 2e-3 * case.nworld * case.steps, measure=measure, tables=tables,
    options=Options, parallel=True,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
