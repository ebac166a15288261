"""Compare the returns of pretrained policies under each integrator and number of substeps, on pairs of episodes.

    lyceum-warp bench integrators
    lyceum-warp bench integrators --tasks go1_velocity --episodes 64

The control interval stays the same. Every setting starts from the same initial states, on the C engine.
"""

import dataclasses
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


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    episodes: int = 32
    """Number of episodes of each setting."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    integrator: str
    """An integrator, or "exact" for the physics of the task."""
    substeps: int
    episodes: int
    seed: int


def cases(options: Options) -> list[Case]:
    tasks = choose(options.tasks, pretrained_tasks(), ("cartpole_swingup",) if options.short else (), what="task")
    episodes = min(options.episodes, 4) if options.short else options.episodes
    cases = []
    for task in tasks:
        frame_skip = find_task(task).frame_skip
        counts = dict.fromkeys((frame_skip, -(-frame_skip // 2), 1))
        settings = [(EXACT, frame_skip), *((name, count) for count in counts for name in INTEGRATORS)]
        cases += [Case(task, *setting, episodes, seed) for seed in options.seeds or (0,) for setting in settings]
    return cases


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    run = lw.Run.open(lw.pretrained_run(case.task))
    threads = {} if options.threads is None else {"nthread": options.threads}
    try:
        env = run_worlds(run, {"engine": "mujoco", "physics": "exact", **threads}, {}, nworld=case.episodes)
    except (FileNotFoundError, ImportError) as error:
        raise Skipped(f"{case.task}: {error}") from error
    if case.integrator != EXACT:
        physics = lw.PhysicsOptions(
            integrator=case.integrator, frame_skip=case.substeps, timestep=float(f"{env.timestep / case.substeps:.10g}")
        )
        try:
            env = env.replicate(physics=physics)
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


def tables(rows: Sequence[Row]) -> list[Table]:
    lines = []
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
    title = (
        "Pretrained policies under each integrator and number of substeps, on equal initial states: the mean return, "
        "its difference from the exact physics of the task with a 95 % interval, terminated episodes and faults."
    )
    header = ["task", "integrator", "substeps", "return", "difference", "terminated", "faults"]
    return [Table(title, header, lines)]


EXPERIMENT = Experiment(
    name="integrators", conditions="The C engine.",
    summary="Returns of pretrained policies under each integrator and number of substeps.",
    cases=cases, estimate=lambda case: 15.0, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
