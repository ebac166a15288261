"""Show the runs of several seeds while they train, and summarise them: lyceum-warp train --seeds."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.live import Live
from rich.table import Table

from lyceum_warp import training
from lyceum_warp.cli.display import console, say, say_entries, table, tried
from lyceum_warp.cli.plot import print_groups


def train_and_show(task: str, folder: Path, seeds: Sequence[int], jobs: int, settings: Mapping[str, Any]) -> int:
    """Train several seeds, and print a summary. The exit code is 1 if a run has failed."""
    states: dict[int, str] = {}

    def note_changes(runs: Sequence[Any]) -> None:
        for run in runs:
            if states.get(run.seed, "waiting") != run.state:
                say(f"seed {run.seed}: {run.state}{f', {run.error}' if run.error else ''} ({run.log})")
            states[run.seed] = run.state

    say(f"{task}: seeds {', '.join(map(str, seeds))} in {folder}; if interrupted, the same command with --out {folder} "
        "continues them")  # fmt: skip
    with Live(console=console, refresh_per_second=2, transient=True) as live:
        watch = (lambda runs: live.update(_progress(runs))) if console.is_terminal else note_changes
        runs = training.train_seeds(task, folder, seeds, jobs=jobs, watch=watch, **settings)
    console.print(_progress(runs))
    groups = training.group_runs(training.read_curves([folder]))
    print_groups(groups)
    failed = [run for run in runs if run.state != "complete"]
    content = {
        "states": {run.seed: run.state for run in runs},
        "groups": [{"task": group.task, "label": group.label, **group.summary()} for group in groups],
    }
    (folder / "summary.json").write_text(json.dumps(content, indent=2))
    figure = tried(training.comparison_figure, groups, folder / "curves.png")
    say_entries(curves=figure, next=f"lyceum-warp plot {folder} OTHER, or lyceum-warp report {runs[0].folder}")
    return 1 if failed else 0


def _progress(runs: Sequence[Any]) -> Table:
    rows = []
    for run in runs:
        metrics = run.folder / "metrics.csv"
        lines = training.Run.open(run.folder).rows() if metrics.exists() else []
        last: dict[str, float | None] = lines[-1] if lines else {}
        returns = [value for line in lines if (value := line.get("mean_return")) is not None]
        counts = [f"{last[name]:,.0f}" if name in last else "" for name in ("iteration", "samples")]
        result = "" if last.get("return_mean") is None else f"{last['return_mean']:.5g}"
        rows.append([str(run.seed), run.state, *counts, result, f"{returns[-1]:.5g}" if returns else "", run.error])
    headings = ("seed", "state", "iter", "samples", "return", "mean\npolicy", "error")
    return table(dict(zip(headings, zip(*rows, strict=True), strict=True)))


def settings_of(command: Any, omit: Sequence[str]) -> dict[str, Any]:
    """Return the given options of a command as settings of ``train_seeds``."""
    settings: dict[str, Any] = {}
    for field in dataclasses.fields(command):
        value = getattr(command, field.name)
        if dataclasses.is_dataclass(value):
            settings |= settings_of(value, ())
        elif field.name not in omit and value != field.default:
            settings["from" if field.name == "from_run" else field.name] = value
    return settings
