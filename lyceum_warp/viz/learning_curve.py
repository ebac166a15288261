"""Learning curves."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lyceum_warp.runs import Run, read_metrics
from lyceum_warp.viz import EXTRA

_STOCHASTIC, _MEAN = "#7a8ba3", "#c8502d"


def learning_curve(run: str | Path | Run, out: str | Path | None = None, *, title: str | None = None) -> Path:
    """Draw a run's learning curve as PNG: returns, and the evaluation metric, against samples.

    Args:
        run: A run, its folder, or a table of metrics.
        out: The picture; ``curve.png`` beside the table by default.
        title: What stands above it; the task and the seed by default.

    Returns:
        The picture's path.

    Raises:
        FileNotFoundError: There is no run.
        ValueError: The table can't be read, or has no row.
        ImportError: matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.ticker import EngFormatter
    except ImportError as error:
        raise ImportError(f"drawing a learning curve needs matplotlib: {EXTRA}") from error

    if isinstance(run, Run) or Path(run).is_dir():
        run = run if isinstance(run, Run) else Run.open(run)
        rows, folder = run.rows(), run.folder
        title = title or f"{run.config['task']}, seed {run.config['seed']}"
    else:
        rows, folder = read_metrics(Path(run)), Path(run).parent
    if not rows:
        raise ValueError(f"{folder} has no complete iteration to draw: train it first")

    # Figure by itself, without pyplot: no state shared with a user's own figures, and no display is looked for
    figure = Figure(figsize=(7.5, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    samples = _column(rows, "samples")
    middle, spread = _column(rows, "return_mean"), _column(rows, "return_std")
    low, high = (
        [m - s for m, s in zip(middle, spread, strict=True)],
        [m + s for m, s in zip(middle, spread, strict=True)],
    )
    top.fill_between(samples, low, high, color=_STOCHASTIC, alpha=0.2, linewidth=0, label="± standard deviation")
    line: Any = dict(color=_STOCHASTIC, marker="." if len(rows) < 3 else "")  # a single point is no line
    top.plot(samples, middle, label="stochastic policy", **line)
    _dots(top, rows, "mean_return")
    top.set_ylabel("return")
    top.legend(frameon=False, loc="best")
    bottom.plot(samples, _column(rows, "eval_mean"), **line)
    _dots(bottom, rows, "mean_eval")
    bottom.set_ylabel("evaluation metric\nat the end")
    bottom.set_xlabel("samples")
    bottom.xaxis.set_major_formatter(EngFormatter(sep=""))
    for axes in (top, bottom):
        axes.grid(color="#e4e7eb")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    if title:
        top.set_title(title, loc="left")
    path = Path(out) if out is not None else folder / "curve.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150, format="png")
    return path


def _column(rows: Sequence[dict[str, float | None]], name: str) -> list[float]:
    return [float("nan") if (value := row.get(name)) is None else value for row in rows]


def _dots(axes: Any, rows: Sequence[dict[str, float | None]], name: str) -> None:
    """The mean policy, where it was evaluated."""
    points = [(row["samples"], row[name]) for row in rows if row.get(name) is not None]
    if points:
        x, y = zip(*points, strict=True)
        axes.plot(x, y, color=_MEAN, marker="o", markersize=4, label="mean policy")
