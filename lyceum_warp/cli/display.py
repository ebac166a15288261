"""Print the output of commands: tables, and the paths of plots and videos."""

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import rich.box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from lyceum_warp import viz

if TYPE_CHECKING:
    from lyceum_warp.controllers import Trajectory

_TABLE_ROWS = 15


console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)
"""Output to a file or a pipe has 120 columns, so that tables are not wrapped."""


def say(text: str) -> None:
    """Print text without wrapping its lines."""
    console.print(text, soft_wrap=True, markup=False)


def say_entries(**entries: object) -> None:
    """Print paths and commands by their names, one a line. ``next`` is what to do after the command."""
    for name, entry in entries.items():
        say(f"{name + ':':<12}{entry}")


def note(line: str) -> None:
    """Print a message to stderr."""
    print(f"lyceum-warp: {line}", file=sys.stderr)


COUNTED = {"faults": "fault", "outliers": "outlier", "skipped_updates": "skipped update"}
"""Columns of metrics.csv that count problems, with their labels in messages. Some algorithms do not write all of these
columns."""


def counted(number: int, what: str) -> str:
    """Format a number with a noun, in the plural if necessary."""
    return f"{number:,d} {what}{'s' * (number != 1)}"


COLUMNS = [
    ("iter", "iteration", ".0f"), ("samples", "samples", ",.0f"), ("reward\na step", "reward_mean", ".3g"),
    ("return", "return_mean", ".1f"), ("std", "return_std", ".1f"), ("mean\npolicy", "mean_return", ".1f"),
    ("length", "length_mean", ".0f"), ("eval", "eval_mean", ".3g"), ("success", "success", ".0%"),
    ("KL", "kl", ".3f"), ("loss", "loss", ".3g"), ("samples/s", "samples_per_second", ",.0f"),
]  # fmt: skip
"""Columns of the table: heading, name in metrics.csv, and format."""


def table(columns: Mapping[str, Sequence[str]]) -> Table:
    """Make a table from a mapping of headings to columns, without empty ones. If it is too wide, its cells wrap."""
    columns = {heading: cells for heading, cells in columns.items() if any(cells)}
    table = Table(box=rich.box.SIMPLE, padding=0, pad_edge=False)
    for i, (heading, cells) in enumerate(columns.items()):
        table.add_column(escape(heading), justify="right" if i or cells[0].isdecimal() else "left", overflow="fold")
    for row in zip(*columns.values(), strict=True):
        table.add_row(*map(escape, row))
    return table


def table_of(rows: Sequence[Mapping[str, str]]) -> Table:
    """Make a table from rows, which map headings to cells."""
    return table({heading: [row[heading] for row in rows] for heading in rows[0]})


def curve_table(rows: Sequence[Mapping[str, float | None]]) -> Table:
    """Make a table of at most 15 iterations of a run, without empty columns.

    Iterations that did not evaluate the mean policy are omitted if enough others remain.
    """
    iterations = [known_values(row) for row in rows]
    evaluated = [row for row in iterations[1:-1] if "mean_return" in row]
    selection = [iterations[0], *evaluated, iterations[-1]] if len(evaluated) >= 4 else iterations
    if len(selection) > _TABLE_ROWS:
        selection = [selection[round(i * (len(selection) - 1) / (_TABLE_ROWS - 1))] for i in range(_TABLE_ROWS)]
    columns = {}
    for heading, name, form in COLUMNS:
        cells = [format(row[name], form) if name in row else "" for row in selection]
        if name == "reward_mean" and all("return_mean" in row for row in iterations):
            continue  # show rewards only if an iteration has no return
        columns[heading] = cells
    curve = table(columns)
    sums = {what: round(sum(row.get(column, 0.0) for row in iterations)) for column, what in COUNTED.items()}
    if bad := [counted(number, what) for what, number in sums.items() if number]:
        curve.caption = f"{' and '.join(bad)} in all {len(rows)} iterations"
    return curve


def known_values(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of a row that have a value."""
    return {name: value for name, value in row.items() if value is not None and not math.isnan(value)}


def tried(make: Callable[..., object], *args: Any, **kwargs: Any) -> str:
    """Call a function that writes a file, and return the path. If the function fails, return "none" and the reason.

    Plots and videos are made from saved results, so the command succeeds even if one of them fails.
    """
    try:
        return str(make(*args, **kwargs))
    except Exception as error:
        return f"none: {viz.one_line(error)}"


def episode_result(trajectory: "Trajectory") -> str:
    """Describe the result of a planner's episode in one line."""
    factor = trajectory.steps * trajectory.timestep / trajectory.wall_seconds
    end = "success, " if trajectory.succeeded else "ended early, " if trajectory.terminated else ""
    return (
        f"{end}return {trajectory.episode_return:.4g}, evaluation {trajectory.evals[-1]:.3g} after "
        f"{trajectory.steps} steps, {trajectory.wall_seconds:.3g} s, {factor:.2f}x real time"
    )
