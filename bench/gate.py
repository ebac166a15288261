"""Test whether policies pass the gates of their tasks, and store the verdicts.

    lyceum-warp bench gate --policy runs/g1
    lyceum-warp bench gate --policy runs/go1-1 runs/go1-2

``lyceum-warp gate`` tests one policy without storing the verdict.
"""

import dataclasses
import hashlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import experiment
import torch
from experiment import Experiment, Row, Table

import lyceum_warp as lw
from lyceum_warp.binding import find_task, task_name
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.engines import options_on_cores


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    policy: tuple[Path, ...] = ()
    """Folders of runs on a task that has a gate, for example g1_velocity."""
    which: str = "last"
    """Policy of each run: last, best, or the number of a saved iteration."""
    task: str | None = None
    """Task whose gate is used, instead of the run's task. The parameters of the run are not applied to it."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    run: str
    policy: str
    seed: int
    quick: bool


def cases(options: Options) -> list[Case]:
    return [
        Case(options.task or lw.Run.open(folder).task_name, folder.name, policy, seed, options.short)
        for folder in options.policy for policy in [digest(folder, options.which)] for seed in options.seeds or (0,)
    ]  # fmt: skip


def digest(folder: Path, which: str) -> str:
    return hashlib.sha256(lw.Run.open(folder).policy_file(which).read_bytes()).hexdigest()[:16]


def measure(case: Case, options: Options) -> dict[str, Any]:
    torch.set_num_threads(1)
    folder = next(folder for folder in options.policy if digest(folder, options.which) == case.policy)
    run = lw.Run.open(folder)
    env = run_worlds(run, {**options_on_cores(), "physics": "exact"}, {}, nworld=1, task=options.task)
    curriculum = None if options.task else lw.load_curriculum(run, which=options.which)
    policy = lw.load(run, which=options.which)
    verdict = lw.gate(
        env, policy, seed=case.seed, curriculum=curriculum, nthread=options.threads, quick=case.quick
    )  # fmt: skip
    return verdict.to_dict()


def tables(rows: Sequence[Row]) -> list[Table]:
    tables = []
    for row in rows:
        result = row.result
        lines = []
        for name, limit in find_task(row.case["task"]).gate.limits.items():  # type: ignore[union-attr]
            if name in result["numbers"]:
                number = result["numbers"][name]
                verdict = ("pass" if limit.allows(number) else "FAIL") if limit.range else ""
                lines.append([limit.text, f"{number:.3g}", limit.range, verdict])
        verdict = "passes" if result["passed"] else "does not pass"
        memory = f", begun at {result['memory']}" if result["memory"] else ""
        title = (
            f"{task_name(find_task(row.case['task']))}: the policy {row.case['policy'][:8]} of {row.case['run']} "
            f"{verdict}{memory}."
        )
        tables.append(Table(title, ["", "measured", "limit", ""], lines))
    return tables


EXPERIMENT = Experiment(
    name="gate", conditions="Robots run on the C engine with exact physics.",
    summary="Whether a policy passes the gate of its task, such as whether a robot walks.",
    cases=cases, estimate=lambda case: 20.0, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
