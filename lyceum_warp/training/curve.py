"""Plot the learning curve of a run."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lyceum_warp.algos import METRIC_COLUMN
from lyceum_warp.training.runs.folder import Run
from lyceum_warp.viz import ACCENT, LINE, finish_axes, new_figure, save_png


def learning_curve(run: str | Path | Run) -> Path:
    """Plot a run's returns and metrics against the number of samples, as ``curve.png`` in the run's folder.

    If no episode has a return, the plot shows the mean reward per step instead.

    Args:
        run: A run, or its folder.

    Raises:
        FileNotFoundError: The run does not exist.
        ValueError: The run's metrics.csv cannot be read, or has no row.
        ImportError: matplotlib is not installed.
    """
    figure = new_figure("a learning curve", 7.5, 6.0)
    from matplotlib import colormaps
    from matplotlib.ticker import EngFormatter

    run = run if isinstance(run, Run) else Run.open(run)
    rows = run.rows()
    if not rows:
        raise ValueError(f"{run.folder} has no complete iteration to plot: continue its training")

    metrics = [name for name in rows[0] if name.startswith(METRIC_COLUMN)]
    figure.set_figheight(8.0 if metrics else 6.0)
    heights = (2, 1, 2) if metrics else (2, 1)
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    top, bottom = panels[:2]
    samples = _column(rows, "samples")
    middle, spread, quantity = _column(rows, "return_mean"), _column(rows, "return_std"), "return"
    if not any(map(math.isfinite, middle + _column(rows, "mean_return"))):
        middle, quantity = _column(rows, "reward_mean"), "reward of a step"
    low = [m - s for m, s in zip(middle, spread, strict=True)]
    high = [m + s for m, s in zip(middle, spread, strict=True)]
    top.fill_between(samples, low, high, color=LINE, alpha=0.2, linewidth=0, label="± standard deviation")
    line: Any = dict(color=LINE, marker="." if len(rows) < 3 else "")  # a line through a single point is invisible
    top.plot(samples, middle, label="stochastic policy", **line)
    _draw_mean_policy(top, rows, "mean_return")
    top.set_ylabel(quantity)
    top.legend(frameon=False, loc="best")
    bottom.plot(samples, _column(rows, "eval_mean"), **line)
    _draw_mean_policy(bottom, rows, "mean_eval")
    bottom.set_ylabel("evaluation metric\nat the end")
    for i, name in enumerate(metrics):
        style = line | {"color": colormaps["viridis"](i / len(metrics)), "label": name.removeprefix(METRIC_COLUMN)}
        panels[2].plot(samples, _column(rows, name), **style)
    if metrics:
        panels[2].set_ylabel("metrics,\nsums of an episode")
        panels[2].legend(frameon=False, loc="best")
    panels[-1].set_xlabel("samples")
    panels[-1].xaxis.set_major_formatter(EngFormatter(sep=""))
    finish_axes(panels)
    top.set_title(f"{run.config['task']}, seed {run.config['seed']}", loc="left")
    return save_png(figure, run.folder / "curve.png")


def _column(rows: Sequence[dict[str, float | None]], name: str) -> list[float]:
    return [float("nan") if (value := row.get(name)) is None else value for row in rows]


def _draw_mean_policy(axes: Any, rows: Sequence[dict[str, float | None]], name: str) -> None:
    points = [(row["samples"], row[name]) for row in rows if row.get(name) is not None]
    if points:
        x, y = zip(*points, strict=True)
        axes.plot(x, y, color=ACCENT, marker="o", markersize=4, label="mean policy")
