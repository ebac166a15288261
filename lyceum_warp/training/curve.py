"""Plot the learning curve of a run, in small multiples."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lyceum_warp.algos import METRIC_COLUMN, STEP_METRIC_COLUMN, Iteration
from lyceum_warp.training.runs.folder import Run
from lyceum_warp.viz import ACCENT, LINE, finish_axes, new_figure, save_figure

GROUPS = ("returns", "reward terms", "metrics", "ends of episodes", "faults", "learning")
"""Groups of panels."""
RETURNS, TERMS, METRICS, ENDS, FAULTS, LEARNING = GROUPS

_SAMPLED, _MEAN = "stochastic policy", "mean policy"

_RETURNS = {
    "return": ("sum of rewards", "return_mean", "mean_return"),
    "evaluation": ("at the end of an episode", "eval_mean", "mean_eval"),
    "length": ("steps of an episode", "length_mean", "mean_length"),
    "success": ("fraction of episodes", "success", "mean_success"),
}
"""Panels of episodes: the title, the unit, and the columns of the stochastic and of the mean policy."""

_FAULTS = ("faults", "outliers", "skipped_updates")


@dataclasses.dataclass(frozen=True)
class Panel:
    """Curves of one quantity over samples."""

    group: str
    title: str
    unit: str
    curves: Mapping[str, Sequence[tuple[float, float]]]
    """Points (samples, value) by the name of the curve. Each curve has at least one point."""


def curve_panels(run: Run) -> list[Panel]:
    """Make the panels of a run's curves. A quantity without a finite value has no panel.

    Raises:
        FileNotFoundError: The run has no metrics yet.
        ValueError: The run's metrics.csv cannot be read, or has no row.
    """
    rows = run.rows()
    if not rows:
        raise ValueError(f"{run.folder} has no complete iteration to plot: continue its training")

    terms = run.config.get("terms", {})
    weights, ends = terms.get("rewards", {}), terms.get("ends", [])
    panels: list[Panel] = []

    def add(group: str, title: str, unit: str, columns: Mapping[str, str]) -> None:
        curves = {}
        for name, column in columns.items():
            values = [(row["samples"] or 0.0, row.get(column)) for row in rows]
            points = [(x, y) for x, y in values if y is not None and math.isfinite(y)]
            if points and (group != FAULTS or any(y for _, y in points)):
                curves[name] = points
        if curves:
            panels.append(Panel(group, title, unit, curves))

    for title, (unit, sampled, mean) in _RETURNS.items():
        add(RETURNS, title, unit, {_SAMPLED: sampled, _MEAN: mean})
    if not any(each.title == "return" for each in panels):  # no episode has ended yet
        add(RETURNS, "reward", "of a step", {_SAMPLED: "reward_mean"})
    iteration_columns = {field.name for field in dataclasses.fields(Iteration)} | {"samples_per_second"}
    for column in rows[0]:
        name = column.removeprefix(METRIC_COLUMN)
        if column in _FAULTS:
            add(FAULTS, name.replace("_", " "), "per iteration", {"count": column})
        elif name == column:
            if column not in iteration_columns and "/" not in column and not column.startswith("time_"):
                add(LEARNING, name.replace("_", " "), "", {"value": column})
        elif name in weights:
            add(TERMS, name, f"weight {weights[name]:g}, sum of an episode", {"term": column})
        elif name in ends:
            add(ENDS, name, "fraction of episodes", {"end": column})
        else:
            add(METRICS, name, "mean of a step", {"metric": STEP_METRIC_COLUMN + name})
    return sorted(panels, key=lambda each: GROUPS.index(each.group))


def draw_panel(axes: Any, panel: Panel) -> None:
    """Draw the curves of a panel."""
    from matplotlib.ticker import EngFormatter

    for name, points in panel.curves.items():
        x, y = zip(*points, strict=True)
        style: Any = {"color": ACCENT, "marker": "o", "markersize": 2.5} if name == _MEAN else {"color": LINE}
        if len(x) < 3:  # a line through a single point is invisible
            style["marker"] = "."
        axes.plot(x, y, label=name, linewidth=1.3, **style)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def learning_curve(run: str | Path | Run) -> Path:
    """Plot a run's returns and metrics against the number of samples, as ``curve.png`` in the run's folder.

    Each reward term, each other metric, and each reason for an end has a panel of its own. If no episode has a return,
    the plot shows the mean reward per step instead.

    Args:
        run: A run, or its folder.

    Raises:
        FileNotFoundError: The run does not exist.
        ValueError: The run's metrics.csv cannot be read, or has no row.
        ImportError: matplotlib is not installed.
    """
    run = run if isinstance(run, Run) else Run.open(run)
    panels = curve_panels(run)
    # a student that was not evaluated has learning signals only
    first, *others = [panel for panel in panels if panel.group != LEARNING] or panels
    columns = min(4, max(1, len(others)))
    height = 1 + math.ceil(len(others) / columns) if others else 1
    figure = new_figure("a learning curve", 7.5 if columns < 4 else 10.0, 3.0 + 1.8 * (height - 1))
    grid = figure.add_gridspec(height, columns, height_ratios=[1.7, *[1.0] * (height - 1)])
    places = [grid[0, :], *(grid[1 + k // columns, k % columns] for k in range(len(others)))]
    for panel, place in zip((first, *others), places, strict=True):
        axes = figure.add_subplot(place)
        draw_panel(axes, panel)
        axes.set_title(panel.title, loc="left", fontsize="small")
        axes.set_ylabel(panel.unit.replace(", ", "\n"), fontsize="small")
        axes.tick_params(labelsize="small")
    figure.axes[0].set_title(f"{run.task_name}, seed {run.config['seed']}", loc="left")
    figure.axes[0].set(xlabel="samples", ylabel=f"{first.title}, {first.unit}")
    figure.axes[0].legend(frameon=False, loc="best")
    finish_axes(figure.axes)
    return save_figure(figure, run.folder / "curve.png")
