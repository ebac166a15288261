"""Show the runs of several seeds while they train, and summarise them: lyceum-warp train --seeds."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.live import Live
from rich.table import Table

from lyceum_warp import core, training
from lyceum_warp.cli.display import COLUMNS, console, known_values, say, say_entries, table_of, tried
from lyceum_warp.cli.plot import print_groups

_OF_THE_WHOLE = {"task", "seeds", "jobs", "out", "go_on", "verbose", "env", "physics", "hyperparameters"}
"""Fields of the command that are no options of a seed's run."""


def train_and_show(command: Any, folder: Path) -> int:
    """Train the seeds of a command ``Train``, and print a summary. The exit code is 1 if a run has failed."""
    options: dict[str, Any] = {}
    for part in (command, command.env, command.physics, command.hyperparameters):
        options |= core.given_values(part)
    settings = {name.removesuffix("_run"): value for name, value in options.items() if name not in _OF_THE_WHOLE}
    seeds = command.seeds[0] if len(command.seeds) == 1 else command.seeds
    say(f"{command.task}: runs in {folder}, each with a log; to continue, repeat the command with --out {folder}")
    with Live(console=console, refresh_per_second=2) as live:
        runs = training.train_seeds(
            command.task, folder, seeds, jobs=command.jobs, watch=lambda runs: live.update(_progress(runs)), **settings
        )
    if not any((run.folder / "metrics.csv").exists() for run in runs):
        return 1  # the table has the errors
    groups = training.group_runs(training.read_curves([folder]))
    print_groups(groups)
    figure = tried(training.comparison_figure, groups, folder / "curves.png")
    say_entries(curves=figure, next=f"lyceum-warp plot {folder} OTHER, or lyceum-warp report {runs[0].folder}")
    return int(any(run.state != "complete" for run in runs))


def _progress(runs: Sequence[Any]) -> Table:
    rows = []
    for run in runs:
        last: dict[str, float] = {}
        for row in training.Run.open(run.folder).rows() if (run.folder / "metrics.csv").exists() else ():
            last |= known_values(row)
        numbers = {heading: format(last[name], form) if name in last else "" for heading, name, form in COLUMNS[:6]}
        rows.append({"seed": str(run.seed), "state": run.state, **numbers, "error": run.error})
    return table_of(rows)
