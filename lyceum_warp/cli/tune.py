"""Find the fastest physics options that do not change a task's returns: lyceum-warp tune."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from lyceum_warp.cli.arguments import ParamWords, Placement, TaskWord, given, parameters
from lyceum_warp.cli.display import console, note, say, say_entries, table
from lyceum_warp.tuning import Difference, Tuning, tune


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tune:
    """Measure the gains and side effects of physics options, and find the fastest that do not change a task's returns.

    Each setting is compared with the unchanged task by steps per second, memory, faults and returns. The returns come
    from the same episodes under random actions and, with --run, under a policy. Every result is appended to a JSON
    Lines file, so the same command continues a stopped search. docs/physics.md explains the table.

    $ lyceum-warp tune hopper --short
    $ lyceum-warp tune humanoid --run runs/humanoid-20260101-120000
    $ lyceum-warp tune humanoid --planning
    $ lyceum-warp tune go1_velocity --device cuda --nworld 8192 --tolerance loose
    """

    task: TaskWord
    run_folder: Annotated[Path | None, tyro.conf.arg(name="run", metavar="RUN")] = None
    """The folder of a run of the task. The run's policy also plays the episodes, and the run's task parameters are the
    defaults."""
    which: str = "last"
    """The policy of --run to use: last, best, or the number of a saved iteration."""
    tolerance: Annotated[str, tyro.conf.arg(metavar="strict|loose|any")] = "strict"
    """How much the mean return may change. The 95 % interval of the change must lie within 2 % (strict) or 5 % (loose)
    of the mean absolute return. For tasks without terminations, the same holds for the fraction of clearly worse
    episodes. With "any", returns may change, but a setting must not cause additional faults.
    """
    short: bool = False
    """Compare the first 100 steps of episodes, for a few seconds per setting."""
    episodes: int | None = None
    """Number of episodes for each setting. The default is enough episodes for a narrow confidence interval. These
    episodes take at most a minute (5 s with --short).
    """
    planning: bool = False
    """Find physics options for the task's planner: compare planning times, and test whether coarser physics rank the
    samples in the same order. --nworld is then the number of samples. The planner plans from three kinds of states:
    standing, moving and fallen. --episodes is the number of states of each kind.
    """
    nworld: int | None = None
    """Number of worlds. By default 256, or 4096 on a GPU. With --planning, the number of samples, by default 64."""
    seed: int = 0
    """Seed of initial states and actions."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File of the results, by default tune/TASK.jsonl or tune/TASK-planning.jsonl. Settings in the file are not
    measured again."""
    param: ParamWords = ()
    env: Annotated[Placement, tyro.conf.arg(name="world")] = Placement()

    def run(self) -> None:
        torch.set_num_threads(1)
        options = given(self.env)
        if self.nworld is not None:
            options["nworld"] = self.nworld
        tuning = tune(
            self.task, run=self.run_folder, which=self.which, tolerance=self.tolerance, short=self.short,
            episodes=self.episodes, planning=self.planning, out=self.out, seed=self.seed, progress=_progress,
            **options, **parameters(self.param),
        )  # fmt: skip
        _report(tuning, self)


def _progress(row: dict[str, Any]) -> None:
    if row["verdict"] == "refused":
        note(f"{row['name']}: refused")
    else:
        note(f"{row['name'] or 'the task as it is'}: {row['speedup']:.2f} x, {row['verdict']}")


def _report(tuning: Tuning, options: Tune) -> None:
    reference = tuning.reference
    identity = reference["identity"]
    say(f"{identity['task']}: {identity['nworld']} worlds, {identity['engine']} engine on {identity['device']}")
    rows = [*(row for row in tuning.rows if not row["refused"]), reference]
    columns = {"setting": [row["name"] or "the task as it is" for row in rows]}
    columns |= _planning_columns(rows, reference) if options.planning else _columns(rows, reference)
    columns["verdict"] = [row["verdict"] for row in rows]
    console.print(table(columns))
    for row in tuning.rows:
        if row["verdict"] == "refused":
            say(f"refused: {row['name']}: {row['refused']}")
        elif row["verdict"] == "ranks badly":
            kind = min(row["ranks"], key=lambda kind: row["ranks"][kind]["mean"])
            mean = row["ranks"][kind]["mean"]
            say(f"not suggested: {row['name']}: the rank correlation of samples is {mean:.2f} in {kind} states")
    if tuning.best is None:
        unknown = sum(row["verdict"] == "not shown" for row in tuning.rows)
        hint = f" ({unknown} not shown: more --episodes may decide)" if unknown else ""
        say(f"no faster setting satisfies --tolerance {options.tolerance}{hint}")
    else:
        say(f"best within {options.tolerance}: {tuning.best['name']}, {tuning.best['speedup']:.2f} times as fast")
        say(f"flags: {tuning.flags}")
        say(f"task:  {tuning.task_line}")
    command = "plan" if options.planning else "train"
    say_entries(results=tuning.path, next=f"lyceum-warp {command} {options.task} {tuning.flags}".rstrip())


def _columns(rows: list[dict[str, Any]], reference: dict[str, Any]) -> dict[str, list[str]]:
    columns = {
        "steps/s": [f"{row['steps_per_second']:,.0f}" for row in rows],
        "speed": [f"{row['speedup']:.2f}" for row in rows],
        "kB/\nworld": [f"{row['bytes_per_world'] / 1e3:.1f}" for row in rows],
        "faults/\nmillion": [f"{row['faults_per_million']:.3g}" if row["returns"] else "" for row in rows],
    }
    for name, heading in (("returns", "return, %"), ("clearly_worse", "clearly worse, %")):
        for source in reference.get(name, ()):
            intervals = [Difference(**row[name][source]) if source in row[name] else "" for row in rows]
            columns[f"{heading},\n{source}"] = list(map(str, intervals))
    return columns


def _planning_columns(rows: list[dict[str, Any]], reference: dict[str, Any]) -> dict[str, list[str]]:
    columns = {
        "plan, ms": [f"{row['plan_ms']:.1f}" for row in rows],
        "speed": [f"{row['speedup']:.2f}" for row in rows],
    }
    for kind in reference["ranks"]:
        columns[f"ranks,\n{kind}"] = ["{mean:.2f} [{low:.2f}, {high:.2f}]".format(**row["ranks"][kind]) for row in rows]
    return columns
