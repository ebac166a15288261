"""Measure physics options of a task, and find the fastest with the same returns: lyceum-warp tune."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import rich.box
import torch
import tyro
from rich.table import Table

from lyceum_warp.cli.arguments import ParamWords, Placement, TaskWord, parameters
from lyceum_warp.cli.display import make_console, note
from lyceum_warp.tuning.judgement import Difference
from lyceum_warp.tuning.search import Tuning, tune
from lyceum_warp.tuning.trial import DIVERGENCE_STEPS, NUDGE


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tune:
    """Measure what each physics option of a task buys and what it changes, and print the fastest with equal returns.

    Each setting is compared with the task as it is: steps per second, memory, faults, the divergence of trajectories,
    and the returns of the same episodes under random actions and, with --run, under a policy. Every result is appended
    to a file of JSON lines; the same command continues a search that was stopped. docs/physics.md explains the table.

    $ lyceum-warp tune hopper --short
    $ lyceum-warp tune humanoid --run runs/humanoid-20260101-120000
    $ lyceum-warp tune go1_velocity --device cuda --nworld 8192 --tolerance loose
    """

    task: TaskWord
    run_folder: Annotated[Path | None, tyro.conf.arg(name="run", metavar="RUN")] = None
    """A run of this task, whose policy runs the same episodes. Its task parameters are the defaults."""
    which: str = "last"
    """Which policy of --run: last, best, or the number of a saved iteration."""
    tolerance: Annotated[str, tyro.conf.arg(metavar="strict|loose|any")] = "strict"
    """Largest difference of returns, relative to the mean absolute return: the 95 % interval must lie within 2 %
    (strict) or 5 % (loose); any accepts all settings without additional faults."""
    short: bool = False
    """Compare the first 100 steps of episodes, for a few seconds for each setting, instead of whole episodes."""
    episodes: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Number of episodes of each setting; by default as many as the interval needs, within a minute (3 s with
    --short)."""
    nworld: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Number of worlds; by default 256, or 4096 on a GPU."""
    seed: int = 0
    """Seed of initial states and actions."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File of the results, by default tune/TASK.jsonl. Results that it has are not measured again."""
    param: ParamWords = ()
    env: tyro.conf.OmitArgPrefixes[Placement] = dataclasses.field(default_factory=Placement)

    def run(self) -> int:
        """Run the command, and return the exit code."""
        torch.set_num_threads(1)
        words: dict[str, Any] = vars(self.env) | parameters(self.param, self)
        if self.nworld is not None:
            words["nworld"] = self.nworld
        tuning = tune(
            self.task, run=self.run_folder, which=self.which, tolerance=self.tolerance, short=self.short,
            episodes=self.episodes, out=self.out, seed=self.seed, progress=_progress, **words,
        )  # fmt: skip
        _report(tuning, self)
        return 0


def _progress(row: dict[str, Any]) -> None:
    if row["verdict"] == "refused":
        note(f"{row['name']}: refused")
    else:
        note(f"{row['name'] or 'the task as it is'}: {row['speedup']:.2f} x, {row['verdict']}")


_HEADINGS = (
    "setting",
    "steps/s",
    "speed",
    "kB/\nworld",
    "faults/\nmillion",
    *(f"diverg.\n{n}" for n in DIVERGENCE_STEPS),
)


def _report(tuning: Tuning, options: Tune) -> None:
    """Print the table of all settings, the best setting, and what was not tried."""
    console, reference = make_console(), tuning.reference
    sources = list(reference["returns"])
    table = Table(box=rich.box.SIMPLE, padding=(0, 1), pad_edge=False)
    for heading in (*_HEADINGS, *(f"return, %\n{source}" for source in sources), "verdict"):
        table.add_column(heading, justify="left" if heading in ("setting", "verdict") else "right")
    nudged = reference["nudged_divergence"]
    shown = [row for row in tuning.rows if not row["refused"]]
    for row in [*shown, reference]:
        ratios = [_short(own / max(chaos, 1e-300)) for own, chaos in zip(row["divergence"], nudged, strict=True)]
        returns = [str(Difference(**row["returns"][s])) if s in row["returns"] else "" for s in sources]
        faults = f"{row['faults_per_million']:.3g}" if row["returns"] else ""
        table.add_row(
            row["name"] or "the task as it is", f"{row['steps_per_second']:,.0f}", f"{row['speedup']:.2f}",
            f"{row['bytes_per_world'] / 1e3:.1f}", faults, *ratios, *returns, row["verdict"],
        )  # fmt: skip
    who = reference["identity"]
    console.print(
        f"{who['task']}: {who['nworld']} worlds, {who['engine']} engine on {who['device']}; "
        f"{tuning.in_contact:.0%} of the states in contact", soft_wrap=True, markup=False,
    )  # fmt: skip
    console.print(table)
    console.print(
        f"diverg. is the divergence after 1, 10 and 50 steps, as a multiple of that of the exact physics from states "
        f"moved by {NUDGE:g}: {', '.join(f'{value:.1e}' for value in nudged)}", soft_wrap=True,
    )  # fmt: skip
    for row in tuning.rows:
        if row["refused"]:
            console.print(f"refused: {row['name']}: {row['refused']}", soft_wrap=True, markup=False)
    for line in tuning.not_tried:
        console.print(f"not tried: {line}", soft_wrap=True, markup=False)
    if tuning.best is None:
        unknown = sum(row["verdict"] == "not shown" for row in tuning.rows)
        hint = f" ({unknown} not shown: more --episodes may decide)" if unknown else ""
        console.print(f"best within {options.tolerance}: the task as it is{hint}", soft_wrap=True)
    else:
        console.print(f"best within {options.tolerance}: {tuning.best['name']}, {tuning.best['speedup']:.2f} times "
                      "as fast", soft_wrap=True, markup=False)  # fmt: skip
        console.print(f"flags: {tuning.flags}", soft_wrap=True, markup=False)
        console.print(f"task:  {tuning.task_line}", soft_wrap=True, markup=False)
    console.print(f"results: {tuning.path}", soft_wrap=True, markup=False)


def _short(ratio: float) -> str:
    """A ratio of any size in few characters."""
    return f"{ratio:.0e}" if ratio >= 1e4 else f"{ratio:.2g}" if ratio < 10 else f"{ratio:,.0f}"
