"""Write a fit's report, one HTML page with pictures."""

import base64
import html
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lyceum_warp.fitting.result import Fit
from lyceum_warp.training import html_page
from lyceum_warp.viz import LINE, finish_axes, new_figure, save_figure


def write_report(
    folder: Path, fit: Fit, name: str, times: np.ndarray, residuals: np.ndarray, groups: Mapping[str, np.ndarray]
) -> None:
    """Write the pictures, and report.html, which contains them.

    Args:
        folder: Where to write.
        fit: The fit.
        name: Name of the model.
        times: Times of the samples in seconds, (windows, samples).
        residuals: In multiples of the noise, (windows, samples, columns).
        groups: Columns of each kind of measurement.
    """
    correlations = new_figure("a fit", 3.0 + 0.25 * len(fit.names), 2.0 + 0.25 * len(fit.names))
    axes = correlations.subplots()
    correlations.colorbar(axes.imshow(fit.correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0))
    axes.set_xticks(range(len(fit.names)), fit.names, fontsize=8, rotation=90)
    axes.set_yticks(range(len(fit.names)), fit.names, fontsize=8)
    over_time = new_figure("a fit", 8.0, 1.6 * len(groups))
    all_axes = over_time.subplots(len(groups), 1, squeeze=False, sharex=True)[:, 0]
    for axes, (label, columns) in zip(all_axes, groups.items(), strict=True):
        axes.plot(times.ravel(), residuals[..., columns].reshape(times.size, -1), ".", ms=1, color=LINE)
        axes.set(ylim=(-6.0, 6.0), ylabel=label)
    all_axes[-1].set_xlabel("time (s)")
    finish_axes(all_axes)
    parts = [f"<pre>{html.escape(fit.text)}</pre><p>{fit.seconds:.0f} s</p>"]
    for title, file, figure in (
        ("Residuals over time, in multiples of the noise", "residuals.png", over_time),
        ("Correlations", "correlations.png", correlations),
    ):
        data = base64.b64encode(save_figure(figure, folder / file).read_bytes()).decode()
        parts.append(f"<h2>{title}</h2><img alt='{title}' style='max-width: 100%' src='data:image/png;base64,{data}'>")
    html_page(folder / "report.html", f"Fit of {name}", parts)
