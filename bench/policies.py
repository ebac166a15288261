"""Compare the pretrained policies between the two engines and between physics options, by `lw.transfer`.

lyceum-warp bench policies
lyceum-warp bench policies --tasks ant --episodes 256
"""

import dataclasses
import sys
from collections.abc import Sequence
from typing import Any

import experiment
import torch
from experiment import Experiment, Row, Skipped, Table, choose

import lyceum_warp as lw
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.training import Run
from lyceum_warp.training.runs.pretrained_runs import pretrained_tasks


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    episodes: int = 64
    """Number of pairs of episodes."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    episodes: int
    seed: int
    device: str


def cases(options: Options) -> list[Case]:
    tasks = choose(options.tasks, pretrained_tasks(), ("cartpole_swingup",) if options.short else (), what="task")
    episodes = min(options.episodes, 4) if options.short else options.episodes
    return [Case(task, episodes, seed, options.device) for task in tasks for seed in options.seeds or (0,)]


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    run = Run.open(lw.pretrained_run(case.task))
    threads = {} if options.threads is None else {"nthread": options.threads}
    try:
        env = run_worlds(run, threads, {}, nworld=1)
    except (FileNotFoundError, ImportError) as error:
        raise Skipped(f"{case.task}: {error}") from error
    return lw.transfer(env, lw.load(run), case.episodes, seed=case.seed, device=case.device).to_dict()


def tables(rows: Sequence[Row]) -> list[Table]:
    lines = []
    for row in sorted(rows, key=lambda row: (row.case["task"], row.case["episodes"])):
        for comparison in row.result["comparisons"]:
            returns, _, failures = comparison["differences"]
            half = (returns["high"] - returns["low"]) / 2
            lines.append([
                row.case["task"], f"{row.case['episodes']}", comparison["second"], comparison["first"],
                f"{returns['second']:,.5g}", f"{returns['first']:,.5g}",
                f"{(returns['high'] + returns['low']) / 2:+.3g} ± {half:.2g}",
                f"{failures['second']:.1%}, {failures['first']:.1%} {failures['quantity']}",
                f"{sum(comparison['faults'])}", comparison["verdict"],
            ])  # fmt: skip
    title = (
        "Pretrained policies on pairs of episodes: mean returns of a simulation and of its reference, their difference "
        'with a 95 % interval, failures (see docs/runs.md) and faults. "C engine" and "Warp engine" run the exact '
        'physics of the task; "exact physics" and "fast physics" run on the C engine.'
    )
    header = ["task", "pairs", "simulation", "reference", "return", "reference's", "difference", "failures", "faults",
              "verdict"]  # fmt: skip
    return [Table(title, header, lines)]


EXPERIMENT = Experiment(
    name="policies", conditions="Tables name the engines and the physics.",
    summary="Transfer of the pretrained policies between engines and physics options.",
    cases=cases, estimate=lambda case: 2.0 * case.episodes, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
