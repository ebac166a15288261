"""Print the output of commands: progress, tables, and the paths of plots and videos."""

import math
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import rich.box
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from lyceum_warp.algos import Iteration, Learner, simulation
from lyceum_warp.controllers import Trajectory
from lyceum_warp.support.long_work import LongWork
from lyceum_warp.training import Callback, Run
from lyceum_warp.viz import one_line

_TABLE_ROWS = 15


console = Console(highlight=False, width=None if sys.stdout.isatty() else 120)
"""Output to a file or a pipe has 120 columns, so that tables are not wrapped."""


def say(text: str) -> None:
    """Print text without wrapping its lines."""
    console.print(text, soft_wrap=True, markup=False)


def note(line: str) -> None:
    """Print a message to stderr."""
    print(f"lyceum-warp: {line}", file=sys.stderr)


class Display(Callback):
    """Shows the progress of training: a live bar on a terminal, otherwise one line per iteration."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.total = 0
        self.mean = math.nan
        self.long_work: LongWork | None = None
        self.progress = Progress(
            BarColumn(bar_width=8), MofNCompleteColumn(), TextColumn("{task.fields[text]}"),
            TimeElapsedColumn(), TimeRemainingColumn(compact=True), TextColumn("left"),
            console=console, disable=not console.is_terminal,
        )  # fmt: skip

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Print the task, its worlds and the run folder, and show a progress bar."""
        env, size = learner.env, learner.team.size
        processes = f" each in {size} processes" if size > 1 else ""
        self.console.print(
            f"[bold]{env.task.name}[/]: {env.obs_space.size} observations, {env.action_space.size} actions; "
            f"{env.nworld} worlds{processes}, {simulation(env)}, {learner.title}; run in {escape(str(run.folder))}",
            soft_wrap=True,
        )  # fmt: skip
        self.total, self.learner, self.simulation = iterations, learner, simulation(env)
        self.bar = self.progress.add_task("", total=iterations, completed=learner.iteration, text="")
        self.progress.start()

    def end(self, run: Run, learner: Learner) -> None:
        """Print the faults."""
        counts = learner.env.fault_counts
        if kinds := ", ".join(f"{number:,d} {kind}" for kind, number in counts.items() if number):
            say(f"faults by their kind (lw.Done): {kinds}; lyceum-warp check names the function of a bad reward")

    def close(self) -> None:
        """End the progress bar."""
        self.progress.stop()

    def __call__(self, it: Iteration) -> None:
        """Show an iteration."""
        if (text := simulation(self.learner.env)) != self.simulation:
            self.console.print(f"from iteration {it.iteration} on: {text}", soft_wrap=True)
            self.simulation = text
        if it.mean_return is not None:
            self.mean = it.mean_return
        mean_return = self.mean if self.console.is_terminal or it.mean_return is not None else math.nan
        row = _known(it.row())
        # the return is unknown until the first episode ends
        reward = f"reward {row['reward_mean']:.3g} a step" if "reward_mean" in row else ""
        result = f"return {row['return_mean']:.4g}" if "return_mean" in row else reward
        mean = "" if math.isnan(mean_return) else f"(mean policy {mean_return:.4g})"
        success = f"success {row['success']:.0%}" if "success" in row else ""
        bad = [counted(number, what) for column, what in _COUNTED.items() if (number := row.get(column))]
        rate = f"{row['samples_per_second'] / 1000:.3g}k samples/s" if "samples_per_second" in row else ""
        loss = f"loss {row['loss']:.3g}" if "loss" in row else ""
        text = " ".join(filter(None, [result, loss, *bad, mean, success, rate]))
        if self.console.is_terminal:
            text = textwrap.shorten(text, self.console.width - _BAR_WIDTH, placeholder="…")
            self.progress.update(self.bar, completed=it.iteration, text=text)
        else:
            self.console.print(f"iteration {it.iteration:4d}/{self.total}  {text}", soft_wrap=True)
            sys.stdout.flush()

    def work(self, text: str, unit: str, done: int, total: int) -> None:
        """Show the progress of work between two iterations, such as rendering a video."""
        if self.console.is_terminal:
            self.progress.update(self.bar, text=f"{text}: {done}/{total} {unit}")
            return
        if self.long_work is None or (self.long_work.text, self.long_work.unit) != (text, unit):
            self.long_work = LongWork(text, unit, self.console)
        self.long_work(done, total)
        if done >= total:
            self.long_work = None


_COUNTED = {"faults": "fault", "outliers": "outlier", "skipped_updates": "skipped update"}
"""Columns of metrics.csv that count problems, with their labels in messages. Some algorithms do not write all of these
columns."""

_BAR_WIDTH = 36
"""Number of characters that the bar, the iteration number and the times take up together."""


def counted(number: int, what: str) -> str:
    """Format a number with a noun, in the plural if necessary."""
    return f"{number:,d} {what}{'s' * (number != 1)}"


_COLUMNS = [
    ("iter", "iteration", ".0f"), ("samples", "samples", ",.0f"), ("reward\na step", "reward_mean", ".3g"),
    ("return", "return_mean", ".1f"), ("std", "return_std", ".1f"), ("mean\npolicy", "mean_return", ".1f"),
    ("length", "length_mean", ".0f"), ("eval", "eval_mean", ".3g"), ("success", "success", ".0%"),
    ("KL", "kl", ".3f"), ("loss", "loss", ".3g"), ("samples/s", "samples_per_second", ",.0f"),
]  # fmt: skip
"""Columns of the table: heading, name in metrics.csv, and format."""


def table(columns: Mapping[str, Sequence[str]]) -> Table:
    """Make a table from a mapping of headings to columns. If the table is too wide for the console, cells wrap."""
    table = Table(box=rich.box.SIMPLE, padding=0, pad_edge=False)
    for i, (heading, cells) in enumerate(columns.items()):
        table.add_column(escape(heading), justify="right" if i or cells[0].isdecimal() else "left", overflow="fold")
    for row in zip(*columns.values(), strict=True):
        table.add_row(*map(escape, row))
    return table


def curve_table(rows: Sequence[Mapping[str, float | None]]) -> Table:
    """Make a table of at most 15 iterations of a run, without empty columns.

    Iterations that did not evaluate the mean policy are omitted if enough others remain.
    """
    iterations = [_known(row) for row in rows]
    evaluated = [row for row in iterations[1:-1] if "mean_return" in row]
    selection = [iterations[0], *evaluated, iterations[-1]] if len(evaluated) >= 4 else iterations
    if len(selection) > _TABLE_ROWS:
        selection = [selection[round(i * (len(selection) - 1) / (_TABLE_ROWS - 1))] for i in range(_TABLE_ROWS)]
    columns = {}
    for heading, name, form in _COLUMNS:
        cells = [format(row[name], form) if name in row else "" for row in selection]
        if name == "reward_mean" and all("return_mean" in row for row in iterations):
            continue  # show rewards only if an iteration has no return
        if any(cells):
            columns[heading] = cells
    curve = table(columns)
    sums = {what: round(sum(row.get(column, 0.0) for row in iterations)) for column, what in _COUNTED.items()}
    if bad := [counted(number, what) for what, number in sums.items() if number]:
        curve.caption = f"{' and '.join(bad)} in all {len(rows)} iterations"
    return curve


def _known(row: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in row.items() if value is not None and not math.isnan(value)}


def tried(make: Callable[..., object], *args: Any, **kwargs: Any) -> str:
    """Call a function that writes a file, and return the path. If the function fails, return "none" and the reason.

    Plots and videos are made from saved results, so the command succeeds even if one of them fails.
    """
    try:
        return str(make(*args, **kwargs))
    except Exception as error:
        return f"none: {one_line(error)}"


def episode_result(trajectory: Trajectory) -> str:
    """Describe the result of a planner's episode in one line."""
    factor = trajectory.steps * trajectory.timestep / trajectory.wall_seconds
    end = "success, " if trajectory.succeeded else "ended early, " if trajectory.terminated else ""
    return (
        f"{end}return {trajectory.episode_return:.4g}, evaluation {trajectory.evals[-1]:.3g} after "
        f"{trajectory.steps} steps, {trajectory.wall_seconds:.3g} s, {factor:.2f}x real time"
    )
