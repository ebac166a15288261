"""Define ``lw.Fit``, which holds what a log says about a model."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lyceum_warp.support.docstrings import document_attributes


@document_attributes
@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """What a log says about a model."""

    names: Sequence[str]
    """Names of the parameters, as in "kp.*_knee"."""
    kinds: Sequence[str]
    """"factor" if the value is a factor of the nominal value, else the kind of the value."""
    value: np.ndarray
    """Fitted values, (parameters,)."""
    low: np.ndarray
    """Lower ends of the 95 % intervals, (parameters,)."""
    high: np.ndarray
    """Upper ends of the 95 % intervals, (parameters,)."""
    determined: np.ndarray
    """Whether the log determines each parameter: its posterior has less than 0.3 times the width of its prior."""
    directions: Sequence[Mapping[str, float]]
    """Combinations of parameters that the log can't tell apart: their weights, in multiples of the priors."""
    correlation: np.ndarray
    """Correlations of the posterior, (parameters, parameters)."""
    noise: Mapping[str, float]
    """Standard deviation of the noise of each kind of measurement."""
    errors: Mapping[str, tuple[float, float]]
    """Root mean square of the errors of prediction in windows that were held back, with the nominal and with the fitted
    values, by kind of measurement. The initial state of each window is estimated in both cases."""
    held_out: tuple[float, float]
    """The same over all measurements, in multiples of the noise."""
    fields: Mapping[str, Mapping[str, Any]]
    """Fitted rows of model fields, by field and element."""
    delays: Mapping[str, float]
    """Fitted delays of actuators in seconds."""
    notes: Sequence[str]
    """What to know about the log and the fit."""
    seconds: float
    """Wall seconds of the fit."""
    substeps: int
    """Substeps that the fit simulated."""
    folder: Path | None = None
    """The folder, which ``lw.make(..., fitted=folder)`` reads."""

    @property
    def table(self) -> str:
        """Format the parameters as lines of text."""
        width = max(map(len, self.names))
        lines = []
        for i, name in enumerate(self.names):
            interval = f"{self.value[i]:10.4g}  [{self.low[i]:.4g}, {self.high[i]:.4g}]"
            unit = " x nominal" if self.kinds[i] == "factor" else ""
            lines.append(f"{name:{width}} {interval}{unit}{'' if self.determined[i] else '  undetermined'}")
        return "\n".join(lines)
