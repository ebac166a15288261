"""Define the common style of all plots, and write their files."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lyceum_warp.support.extras import check_extra

LINE, ACCENT, GRID = "#7a8ba3", "#c8502d", "#e4e7eb"


STYLES = (
    ("#D55E00", "o", "-"), ("#0072B2", "s", "--"), ("#009E73", "^", "-."), ("#CC79A7", "D", ":"),
    ("#E69F00", "v", (0, (5, 1))), ("#56B4E9", "P", (0, (3, 1, 1, 1))), ("#000000", "X", "-"),
)  # fmt: skip
"""Colours (Okabe and Ito's palette for colour-blind readers), markers and line styles."""


def new_figure(purpose: str, width: float, height: float) -> Any:
    """Make a figure without pyplot. The figure needs no display, and shares no state with the user's figures."""
    check_extra(f"plotting {purpose}", "viz", "matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def finish_axes(all_axes: Iterable[Any]) -> None:
    """Add a grid behind the lines, and remove the top and right borders."""
    for axes in all_axes:
        axes.grid(color=GRID)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)


def save_figure(figure: Any, out: str | Path) -> Path:
    """Write a figure to a file in a new or existing folder, and return the path.

    Raises:
        ValueError: matplotlib has no format with the file's suffix.
    """
    path = Path(out)
    if path.suffix[1:] not in (formats := figure.canvas.get_supported_filetypes()):
        raise ValueError(f"a figure's file must end in one of {', '.join(sorted(formats))}, not {path.name!r}")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
    return path
