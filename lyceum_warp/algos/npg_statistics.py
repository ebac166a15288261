"""Compute the statistics of an NPG iteration that concern the value function."""

import dataclasses
from collections.abc import Mapping, Sequence

import torch

from lyceum_warp.algos.rollout_statistics import OnPolicyIteration, pooled
from lyceum_warp.support.docstrings import document_attributes


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class NPGIteration(OnPolicyIteration):
    """Statistics of one iteration of NPG.

    Episode statistics cover the episodes that ended in the iteration; they are NaN if no episode ended.
    """

    step_norm: float
    """Euclidean norm of the full step in the policy's parameters."""
    step_fraction: float
    """Fraction of the full step that was applied; less than 1 if the full step exceeded the limit of the KL
    divergence."""
    gradient_norm: float
    """Euclidean norm of the vanilla policy gradient."""
    value_error: float
    """Squared error of the value function before the fit, divided by the squared error of always predicting 0."""
    explained_variance: float
    """Fraction of the returns' variance that the value function explained before the fit."""
    outliers: int
    """Number of advantages that were clipped to ten standard deviations of the returns."""
    skipped_updates: int
    """Number of non-finite updates that were skipped: 0, 1 or 2 (policy, value function)."""
    time_gradient: float
    """Seconds for advantages and the vanilla gradient."""
    time_solve: float
    """Seconds for conjugate gradient and the step."""
    time_value: float
    """Seconds for the value function's fit. Time that overlaps with the step (on two CPU threads) counts only in
    ``time_solve``."""


def prediction_sums(returns: torch.Tensor, predicted: torch.Tensor) -> dict[str, torch.Tensor]:
    """Compute the mean of returns and of prediction errors, and the sums of squared deviations, as scalar tensors."""
    target, error = returns.double(), (returns - predicted).double()
    return {
        "target_mean": (target_mean := target.mean()),
        "target_square": (target - target_mean).square().sum(),
        "error_mean": (error_mean := error.mean()),
        "error_square": (error - error_mean).square().sum(),
    }


def value_statistics(sums: Sequence[Mapping[str, float]], samples: int) -> dict[str, float]:
    """Compute ``value_error`` and ``explained_variance`` from each process's sums over its ``samples`` samples."""
    sized = [{**part, "samples": samples} for part in sums]
    n, mean, square = pooled(sized, "samples", "target_mean", "target_square")
    _, error_mean, error_square = pooled(sized, "samples", "error_mean", "error_square")
    error, size = error_square + n * error_mean**2, square + n * mean**2
    return {
        "value_error": error / max(size, 1e-20 * n),
        "explained_variance": 1.0 - error_square / max(square, 1e-20 * n),
    }
