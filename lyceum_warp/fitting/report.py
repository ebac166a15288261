"""Write a fit's report, one HTML page with tables and pictures."""

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lyceum_warp.fitting.result import Fit
from lyceum_warp.training import html_page
from lyceum_warp.viz import ACCENT, LINE, finish_axes, new_figure, save_figure


def write_report(
    fit: Fit, name: str, times: np.ndarray, residuals: np.ndarray, groups: Mapping[str, np.ndarray]
) -> Path:
    """Write the pictures, and report.html, which contains them."""
    folder = fit.folder
    assert folder is not None
    columns = fit.names, fit.value, fit.low, fit.high, fit.kinds, fit.determined
    values = [[key, f"{v:.5g}", f"{a:.5g} to {b:.5g}", "factor" * (kind == "factor"), "" if known else "undetermined"]
              for key, v, a, b, kind, known in zip(*columns, strict=True)]  # fmt: skip
    errors = [[k, f"{a:.3g}", f"{b:.3g}", f"{fit.noise[k]:.3g}"] for k, (a, b) in fit.errors.items()]
    weak = [[" ".join(f"{weight:+.2f} {key}" for key, weight in d.items())] for d in fit.directions]
    parts = [
        *(f"<p>{html.escape(note)}</p>" for note in fit.notes),
        _table("Parameters", ["parameter", "value", "95 % interval", "", ""], values),
        *([_table("What the log can't tell apart", ["direction, in multiples of the priors"], weak)] if weak else []),
        _table("Errors of prediction in windows held back", ["measurement", "nominal", "fitted", "noise"], errors),
    ]
    for title, file, figure in (
        ("95 % intervals and correlations", "intervals.png", _intervals(fit)),
        ("Residuals over time, in multiples of the noise", "residuals.png", _residuals(fit, times, residuals, groups)),
    ):
        data = base64.b64encode(save_figure(figure, folder / file).read_bytes()).decode()
        parts.append(f"<h2>{title}</h2><img alt='{title}' style='max-width: 100%' src='data:image/png;base64,{data}'>")
    parts.append(f"<p>{fit.substeps:,} substeps in {fit.seconds:.0f} s</p>")
    return html_page(folder / "report.html", f"Fit of {name}", parts)


def _table(title: str, head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    rows = ("".join(f"<td>{html.escape(cell)}</td>" for cell in line) for line in [head, *lines])
    return f"<h2>{title}</h2><table>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>"


def _intervals(fit: Fit) -> Any:
    """Draw the intervals and the correlations of the posterior, one row for each parameter."""
    figure, places = new_figure("a fit", 11.0, 1.0 + 0.25 * len(fit.names)), np.arange(len(fit.names))
    axes, right = figure.subplots(1, 2, sharey=True, width_ratios=[2, 1])
    change, half = fit.value - np.isin(fit.kinds, ("factor", "gain")), 0.5 * (fit.high - fit.low)
    scale = np.maximum(np.abs(change), half) + 1e-12
    colors = [LINE if known else ACCENT for known in fit.determined]
    axes.errorbar(change / scale, places, xerr=half / scale, fmt="none", ecolor=colors)
    axes.scatter(change / scale, places, c=colors, s=16)
    axes.set_yticks(places, fit.names, fontsize=8)
    axes.set_xlabel("change from the nominal value, in multiples of the change or of the interval")
    finish_axes([axes])
    figure.colorbar(right.imshow(fit.correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="auto"))
    right.set_xlabel("correlations")
    return figure


def _residuals(fit: Fit, times: np.ndarray, residuals: np.ndarray, groups: Mapping[str, np.ndarray]) -> Any:
    figure = new_figure("a fit", 8.0, 1.6 * len(groups))
    all_axes = figure.subplots(len(groups), 1, squeeze=False, sharex=True)[:, 0]
    for axes, (label, columns) in zip(all_axes, groups.items(), strict=True):
        rows = residuals[..., columns].reshape(times.size, -1) / fit.noise[label]
        axes.plot(times.ravel(), rows, ".", ms=1, color=LINE)
        axes.set(ylim=(-6.0, 6.0), ylabel=label)
    all_axes[-1].set_xlabel("time (s)")
    finish_axes(all_axes)
    return figure
