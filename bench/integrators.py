"""Compare pretrained policies and planners under each integrator and number of substeps, on pairs of episodes.

    lyceum-warp bench integrators
    lyceum-warp bench integrators --tasks go1_velocity --episodes 64
    lyceum-warp bench integrators --tasks g1_stand --parts planners

The control interval stays the same. Every setting starts from the same initial states, on the C engine. A policy acts
in worlds with the setting. A planner's samples have the setting, and the worlds that it controls have exact physics.
"""

import dataclasses
import itertools
import sys
from collections.abc import Sequence
from typing import Any

import experiment
import numpy as np
import torch
from experiment import Experiment, Row, Skipped, Table, choose

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.support.intervals import mean_interval
from lyceum_warp.training.runs.pretrained_runs import pretrained_tasks

EXACT = "exact"
INTEGRATORS = ("euler", "implicitfast", "discrete")
PLANNED = {
    "reach": 1.5, "panda_lift": 5.0, "g1_stand": 3.0, "g1_walk": 3.0, "humanoid_stand": 3.0, "humanoid_walk": 3.0,
    "humanoid_get_up": 3.0, "herb_reach": 2.0,
}  # fmt: skip
"""Tasks with a planner, and the seconds of an episode."""
PLANNED_EPISODES = 5


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    episodes: int = 32
    """Number of episodes of each setting of a policy."""
    parts: tuple[str, ...] = ()
    """Parts: policies, planners; by default both."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    integrator: str
    """An integrator, or "exact" for the physics of the task."""
    substeps: int
    episodes: int
    seed: int


@dataclasses.dataclass(frozen=True)
class PlannerCase(Case):
    seconds: float


def cases(options: Options) -> list[Case]:
    tasks = {"policies": pretrained_tasks(), "planners": PLANNED}
    parts = choose(options.parts, tasks, what="part")
    known = dict.fromkeys(name for part in parts for name in tasks[part])
    chosen = choose(options.tasks, known, ("cartpole_swingup", "reach") if options.short else (), what="task")
    episodes = min(options.episodes, 4) if options.short else options.episodes
    cases: list[Case] = []
    for part, task in ((part, task) for part in parts for task in chosen if task in tasks[part]):
        frame_skip = find_task(task).frame_skip
        counts = dict.fromkeys((frame_skip, -(-frame_skip // 2), 1))
        settings = [(EXACT, frame_skip), *((name, count) for count in counts for name in INTEGRATORS)]
        for seed, setting in itertools.product(options.seeds or (0,), settings):
            if part == "planners":
                seconds = 0.2 if options.short else PLANNED[task]
                cases.append(PlannerCase(task, *setting, PLANNED_EPISODES, seed, seconds))
            else:
                cases.append(Case(task, *setting, episodes, seed))
    return cases


def physics_of(case: Case, timestep: float) -> str | lw.PhysicsOptions:
    if case.integrator == EXACT:
        return EXACT
    substep = float(f"{timestep / case.substeps:.10g}")
    return lw.PhysicsOptions(integrator=case.integrator, frame_skip=case.substeps, timestep=substep)


def measure_planner(case: PlannerCase, threads: dict[str, int]) -> dict[str, Any]:
    """Control the worlds of all episodes by one planner."""
    env = lw.make(case.task, nworld=case.episodes, engine="mujoco", autoreset=False, **threads)
    physics = physics_of(case, env.timestep)
    plan = lw.MPPI(case.task, plants=case.episodes, seed=case.seed, engine="mujoco", physics=physics, **threads)
    env.rand_reset(seed=case.seed)
    returns, over = torch.zeros(case.episodes), torch.zeros(case.episodes, dtype=torch.bool)
    for _ in range(round(case.seconds / env.timestep)):
        env.action.copy_(plan(env.get_state()))
        env.step()
        returns += env.reward.where(~over, 0.0)
        over |= env.done
    return {
        "returns": [round(value, 4) for value in returns.tolist()], "terminated": int(env.terminated.sum()),
        "faults": sum(env.fault_counts.values()), "timestep": env.timestep,
    }  # fmt: skip


@torch.no_grad()
def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    threads = {} if options.threads is None else {"nthread": options.threads}
    if isinstance(case, PlannerCase):
        return measure_planner(case, threads)
    run = lw.Run.open(lw.pretrained_run(case.task))
    try:
        env = run_worlds(run, {"engine": "mujoco", "physics": "exact", **threads}, {}, nworld=case.episodes)
    except (FileNotFoundError, ImportError) as error:
        raise Skipped(f"{case.task}: {error}") from error
    if case.integrator != EXACT:
        try:
            env = env.replicate(physics=physics_of(case, env.timestep))
        except ValueError as error:
            return {"refused": str(error)}
    episodes = lw.evaluate(
        env, lw.load(run), case.episodes, seed=case.seed, curriculum=lw.load_curriculum(run)
    )  # fmt: skip
    return {
        "returns": [round(value, 4) for value in episodes.returns.tolist()],
        "terminated": int((episodes.terminated > 0).sum()), "faults": sum(env.fault_counts.values()),
        "timestep": env.timestep,
    }  # fmt: skip


def lines_of(rows: Sequence[Row]) -> list[list[str]]:
    lines: list[list[str]] = []
    for (task, episodes, _), same in experiment.grouped(rows, "task", "episodes", "seed").items():
        results = {(row.case["integrator"], row.case["substeps"]): row.result for row in same}
        exact = next((result for (name, _), result in results.items() if name == EXACT), None)
        if exact is None:
            continue
        reference = np.array(exact["returns"])
        for (name, substeps), result in results.items():
            setting = [task, name, f"{substeps} x {1e3 * exact['timestep'] / substeps:.3g} ms"]
            if "refused" in result:
                lines.append([*setting, "refused", "", "", ""])
                continue
            mean, half = mean_interval(np.array(result["returns"]) - reference)
            difference = "" if name == EXACT else f"{mean:+.3g} ± {half:.2g}"
            lines.append([
                *setting, f"{np.mean(result['returns']):,.5g}", difference, f"{result['terminated']} of {episodes}",
                f"{result['faults']}",
            ])  # fmt: skip
    return lines


def tables(rows: Sequence[Row]) -> list[Table]:
    kinds = {
        "Pretrained policies under each integrator and number of substeps, on equal initial states: the mean return, "
        "its difference from the exact physics of the task with a 95 % interval, terminated episodes and faults.":
        [row for row in rows if "seconds" not in row.case],
        "MPPI with samples under each integrator and number of substeps, on equal initial states and seeds: the same "
        "columns. The controlled worlds have exact physics and wait for each plan. The planner has the samples and the "
        "horizon of the task, which two cores can bear, but the integrator and substeps of the row. Episodes are short "
        f"({', '.join(f'{task} {seconds:g} s' for task, seconds in PLANNED.items())}) and few, so intervals are wide.":
        [row for row in rows if "seconds" in row.case],
    }  # fmt: skip
    header = ["task", "integrator", "substeps", "return", "difference", "terminated", "faults"]
    return [Table(title, header, lines) for title, some in kinds.items() if (lines := lines_of(some))]


EXPERIMENT = Experiment(
    name="integrators", conditions="The C engine.",
    summary="Returns of pretrained policies and planners under each integrator and number of substeps.",
    cases=cases, estimate=lambda case: 15.0, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
