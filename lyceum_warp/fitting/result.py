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
    folder: Path | None = None
    """The folder, which ``lw.make(..., fitted=folder)`` reads."""

    @property
    def text(self) -> str:
        """Values, what can't be told apart, errors of prediction, and notes, as lines of text."""
        width, columns = max(map(len, self.names)), (self.names, self.kinds, self.value, self.low, self.high)
        lines = [
            f"{name:{width}} {value:10.4g}  [{low:.4g}, {high:.4g}]{' x nominal' * (kind == 'factor')}"
            f"{'' if known else '  undetermined'}"
            for name, kind, value, low, high, known in zip(*columns, self.determined, strict=True)
        ]
        for weights in self.directions:
            named = (f"{weight:+.2f} {name}" for name, weight in weights.items())
            lines.append(f"can't be told apart: {', '.join(named)}")
        lines.append("errors of prediction in windows held back:")
        for name, (nominal, fitted) in self.errors.items():
            lines.append(f"{name}: {nominal:.3g} nominal, {fitted:.3g} fitted, noise {self.noise[name]:.3g}")
        lines.append("in multiples of the noise: {:.3g} nominal, {:.3g} fitted".format(*self.held_out))
        return "\n".join([*lines, *self.notes])
