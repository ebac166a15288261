"""Compare tasks with unmodified Gymnasium and Gymnasium-Robotics environments, step by step.

    lyceum-warp bench agreement

Both environments start in the same states and get the same random actions, without corrections in between. A new
episode starts after a termination or 200 steps. lyceum_warp runs on the C engine with the task's own physics. The tests
in tests/oracles use the same comparison; their environments of Gymnasium are modified where the tasks differ by design,
and must then agree.
"""

import dataclasses
import importlib
import sys
from collections.abc import Sequence
from typing import Any

import experiment
import mujoco
import numpy as np
from experiment import FOLDER, Experiment, Row, Table, choose

SOLVERS = {int(kind): kind.name.removeprefix("mjSOL_") for kind in mujoco.mjtSolver.__members__.values()}
MODULES = ("test_gymnasium", "test_gymnasium_robotics")
EPISODE = 200
"""Largest number of steps of an episode."""
TOLERANCE = 1e-5
"""Largest relative difference of observations that agree."""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    steps: int = 1000
    """Number of compared steps."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    steps: int
    solver: str
    """Solver of the Gymnasium environment: its own, or the task's if they differ."""


def oracle(name: str) -> Any:
    """Import a module of tests/oracles."""
    for folder in ("tests", "tests/oracles"):
        if (path := str(FOLDER.parent / folder)) not in sys.path:
            sys.path.append(path)
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ValueError(f"{error}: run this in a checkout with pip install -e '.[dev]'") from error


def cases(options: Options) -> list[Case]:
    theirs = [task for name in MODULES for task in getattr(oracle(name), "TASKS", None) or oracle(name).IDS]
    tasks = choose(options.tasks, theirs, ("hopper",) if options.short else (), what="task")
    steps = min(options.steps, 100) if options.short else options.steps
    solvers = {"humanoid": ("own", "task's"), "humanoid_standup": ("own", "task's")}
    return [Case(task, steps, solver) for task in tasks for solver in solvers.get(task, ("own",))]


def measure(case: Case, options: Options) -> dict[str, Any]:
    robotics = case.task in oracle(MODULES[1]).IDS
    pair, rows = (robotics_rows if robotics else gymnasium_rows)(case)
    parts = pair.ours.obs_space.parts
    forces = np.zeros(pair.ours.obs_space.size, bool)
    forces[parts.get("contact_force", slice(0, 0))] = True
    obs = np.array([row[0] for row in rows], float)
    theirs = np.array([row[1] for row in rows], float)
    error = np.abs(obs - theirs) / np.maximum(1.0, np.abs(theirs))
    far = np.flatnonzero((error[:, ~forces] > TOLERANCE).any(1))
    return {
        "agree_steps": int(far[0]) if len(far) else len(rows),
        "obs": float(error[:, ~forces].max()),
        "contact_force": float(np.abs(obs - theirs)[:, forces].max()) if forces.any() else None,
        "reward": max(abs(row[2] - row[3]) for row in rows),
        "reward_scale": float(np.mean([abs(row[3]) for row in rows])),
        "terminations": sum(row[5] for row in rows), "different_terminations": sum(row[4] != row[5] for row in rows),
        "solvers": [SOLVERS[int(env.model.opt.solver)] for env in (pair.ours, pair.theirs)],
    }  # fmt: skip


def gymnasium_rows(case: Case) -> tuple[Any, list[tuple[Any, ...]]]:
    module = oracle(MODULES[0])
    theirs = module.unchanged(case.task)()
    pair = module.Pair(module.make_ours(case.task), theirs)
    if case.solver == "task's":
        theirs.model.opt.solver = pair.ours.model.opt.solver
    steps = pair.run(case.steps, EPISODE)
    return pair, [
        (step.obs, step.gym_obs, step.reward, step.gym_reward, step.terminated, step.gym_terminated) for step in steps
    ]


def robotics_rows(case: Case) -> tuple[Any, list[tuple[Any, ...]]]:
    module = oracle(MODULES[1])
    pair = module.Pair(module.lw.make(case.task, autoreset=False, horizon=0, nthread=1), module.registered(case.task))
    rows = []
    for step in range(case.steps):
        if step % EPISODE == 0:
            pair.reset()
        if step % 4 == 0:
            action = pair.random_action(1.3)
        pair.step(action)
        ended = bool(pair.ours.terminated.item())
        rows.append((pair.ours.obs[0].numpy().copy(), pair.obs, pair.ours.reward.item(), float(pair.reward), ended,
                     bool(pair.terminated)))  # fmt: skip
    return pair, rows


def tables(rows: Sequence[Row]) -> list[Table]:
    lines = []
    for row in rows:
        result = row.result
        ours, theirs = result["solvers"]
        force = result["contact_force"]
        lines.append([
            row.case["task"], f"{ours}, {theirs}", f"{result['agree_steps']:,} of {row.case['steps']:,}",
            f"{result['obs']:.0e}", "" if force is None else f"{force:.2g}",
            f"{result['reward']:.0e} ({result['reward_scale']:.2g})",
            f"{result['different_terminations']} of {result['terminations']}",
        ])  # fmt: skip
    title = (
        "Largest differences between a task on the C engine with its own physics and the unmodified environment of "
        "Gymnasium or Gymnasium-Robotics under random actions: steps until observations without contact forces differ "
        f"by more than {TOLERANCE:g}; these observations (relative to max(1, |value|)); contact forces (N and N m); "
        "rewards (in parentheses, the mean absolute reward); terminations that differ."
    )
    header = [
        "task",
        "solver: task, Gymnasium",
        "steps until they differ",
        "observations",
        "contact forces",
        "reward",
        "terminations",
    ]
    return [Table(title, header, lines)]


EXPERIMENT = Experiment(
    name="agreement", conditions="Tasks run on the C engine with exact physics.",
    summary="Largest differences between tasks and unmodified Gymnasium environments.",
    cases=cases, estimate=lambda case: 10.0, measure=measure, tables=tables, options=Options,
    packages=("gymnasium", "gymnasium-robotics"),
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
