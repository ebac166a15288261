"""Learning curves of several tables of bench/learning.py in one picture.

python bench/curves.py GPU=gpu.csv CPU=cpu.csv --x seconds --out curves.png
"""

import csv
import dataclasses
import statistics
from pathlib import Path
from typing import Literal

import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

LABELS = {
    "return_mean": "return", "return_recent": "return, last 100 episodes", "mean_return": "return of the mean policy",
}  # fmt: skip

COLORS = ("#c8502d", "#3d6fa5", "#5a8f4e", "#8a6bb1")


@dataclasses.dataclass(frozen=True)
class Options:
    """Mean over the seeds, and the band from the least to the most of them."""

    tables: tyro.conf.Positional[tuple[str, ...]]
    """LABEL=TABLE.csv, one or several."""
    out: Path
    """The picture (PNG)."""
    x: Literal["samples", "seconds"] = "samples"
    """What the returns are drawn against."""
    y: Literal["return_mean", "return_recent", "mean_return"] = "return_mean"
    """Return of the stochastic policy in training, in an iteration or in the last 100 episodes (time_to_reward.py), or
    of the mean policy in episodes of its own."""
    title: str = ""
    """What stands above it."""


def curve(path: Path, options: Options) -> tuple[list[float], list[float], list[float], list[float]]:
    """x, mean, least and most over the seeds, for the iterations that all seeds have."""
    with path.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row[options.y] not in ("", "nan")]
    by_iteration: dict[int, list[dict[str, str]]] = {}
    for row in rows:
        by_iteration.setdefault(int(row["iteration"]), []).append(row)
    seeds = max(map(len, by_iteration.values()))
    whole = [by_iteration[i] for i in sorted(by_iteration) if len(by_iteration[i]) == seeds]
    y = [[float(row[options.y]) for row in same] for same in whole]
    x = [statistics.mean(float(row[options.x]) for row in same) for same in whole]
    return x, [statistics.mean(v) for v in y], [min(v) for v in y], [max(v) for v in y]


def main(options: Options) -> None:
    figure = Figure(figsize=(7.0, 4.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for table, color in zip(options.tables, COLORS, strict=False):
        label, _, path = table.rpartition("=")
        x, mean, low, high = curve(Path(path), options)
        axes.fill_between(x, low, high, color=color, alpha=0.18, linewidth=0)
        axes.plot(x, mean, color=color, label=label or Path(path).stem)
    axes.set_xlabel(options.x)
    axes.set_ylabel(LABELS[options.y])
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(color="#e4e7eb")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, loc="best")
    axes.set_title(options.title, loc="left")
    options.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out, dpi=130)


if __name__ == "__main__":
    main(tyro.cli(Options))
