"""Show the runs of several seeds while they train, and summarise them: lyceum-warp train --seeds."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.live import Live
from rich.table import Table

from lyceum_warp import training
from lyceum_warp.cli.display import console, known_values, say, say_entries, table, tried
from lyceum_warp.cli.plot import print_groups

_NUMBERS = {"iteration": ",.0f", "samples": ",.0f", "return_mean": ".5g", "mean_return": ".5g"}
"""Columns of metrics.csv whose last values the table shows, with their formats."""


def train_and_show(task: str, folder: Path, seeds: int | Sequence[int], jobs: int, settings: dict[str, Any]) -> int:
    """Train several seeds, and print a summary. The exit code is 1 if a run has failed."""
    say(f"{task}: runs in {folder}, each with a log; if interrupted, the same command with --out {folder} continues")
    with Live(console=console, refresh_per_second=2) as live:
        runs = training.train_seeds(
            task, folder, seeds, jobs=jobs, watch=lambda runs: live.update(_progress(runs)), **settings
        )
    groups = training.group_runs(training.read_curves([folder]))
    print_groups(groups)
    content = {
        "states": {run.seed: run.state for run in runs},
        "groups": [{"task": group.task, "label": group.label, **group.summary()} for group in groups],
    }
    (folder / "summary.json").write_text(json.dumps(content, indent=2))
    figure = tried(training.comparison_figure, groups, folder / "curves.png")
    say_entries(curves=figure, next=f"lyceum-warp plot {folder} OTHER, or lyceum-warp report {runs[0].folder}")
    return int(any(run.state != "complete" for run in runs))


def _progress(runs: Sequence[Any]) -> Table:
    rows = []
    for run in runs:
        last: dict[str, float] = {}
        for row in training.Run.open(run.folder).rows() if (run.folder / "metrics.csv").exists() else ():
            last |= known_values(row)
        cells = [format(last[name], form) if name in last else "" for name, form in _NUMBERS.items()]
        rows.append([str(run.seed), run.state, *cells, run.error])
    headings = ("seed", "state", "iter", "samples", "return", "mean\npolicy", "error")
    return table(dict(zip(headings, zip(*rows, strict=True), strict=True)))
