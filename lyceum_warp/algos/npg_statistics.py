"""Collect the statistics of an NPG iteration in each process, and summarise them over all processes."""

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import torch

from lyceum_warp.algos.rollout_statistics import (
    EpisodeSums,
    Moments,
    OnPolicyIteration,
    Scalar,
    episode_statistics,
    metric_means,
    pooled,
)
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


class UpdateNumbers(NamedTuple):
    """Statistics of one update of the policy, named as in ``NPGIteration``."""

    finite: Scalar  # whether the step is finite
    kl: Scalar
    step_norm: Scalar
    step_fraction: Scalar
    gradient_norm: Scalar
    std_mean: Scalar
    # of this process only
    reward: Scalar
    faults: Scalar
    outliers: Scalar
    fitted: Scalar  # whether the value function's fit is finite


class ValueSums(NamedTuple):
    """Moments of one process's discounted returns, and of the value function's errors (return minus prediction)."""

    return_mean: Scalar
    return_square: Scalar  # sum of squared deviations
    error_mean: Scalar
    error_square: Scalar


class ProcessNumbers(NamedTuple):
    """One process's part of the statistics of an iteration."""

    update: UpdateNumbers
    values: ValueSums
    episodes: EpisodeSums
    metrics: tuple[Scalar, ...] = ()

    def pack(self) -> torch.Tensor:
        """Pack all numbers into one float64 tensor."""
        return torch.stack([number.double() for part in self for number in part])

    @classmethod
    def unpack(cls, numbers: Iterable[float]) -> "ProcessNumbers":
        """Unpack the result of ``pack``."""
        rest = iter(numbers)
        return cls(
            update=UpdateNumbers(*itertools.islice(rest, len(UpdateNumbers._fields))),
            values=ValueSums(*itertools.islice(rest, len(ValueSums._fields))),
            episodes=EpisodeSums(*itertools.islice(rest, len(EpisodeSums._fields))),
            metrics=tuple(rest),
        )


def prediction_sums(returns: torch.Tensor, predicted: torch.Tensor) -> ValueSums:
    """Compute the moments of returns and of prediction errors."""
    target, error = returns.double(), (returns - predicted).double()
    return ValueSums(
        return_mean=(return_mean := target.mean()),
        return_square=(target - return_mean).square().sum(),
        error_mean=(error_mean := error.mean()),
        error_square=(error - error_mean).square().sum(),
    )


def summary(processes: Sequence[ProcessNumbers], samples: int, metrics: Sequence[str] = ()) -> dict[str, Any]:
    """Combine the numbers of all processes, as floats, into fields of ``NPGIteration``."""
    update = processes[0].update
    return {
        "reward_mean": sum(process.update.reward for process in processes) / len(processes),
        **episode_statistics([process.episodes for process in processes]),
        "kl": update.kl,
        "step_norm": update.step_norm,
        "step_fraction": update.step_fraction,
        "gradient_norm": update.gradient_norm,
        "std_mean": update.std_mean,
        **value_statistics([process.values for process in processes], samples),
        "faults": round(sum(process.update.faults for process in processes)),
        "outliers": round(sum(process.update.outliers for process in processes)),
        "skipped_updates": (not update.finite) + (not update.fitted),
        **metric_means(
            sum(process.episodes.episodes for process in processes), [process.metrics for process in processes], metrics
        ),
    }


def value_statistics(sums: Sequence[ValueSums], samples: int) -> dict[str, float]:
    """Compute the statistics of the value function, with ``samples`` samples from each process."""
    n, mean, square = pooled([Moments(samples, part.return_mean, part.return_square) for part in sums])
    _, error_mean, error_square = pooled([Moments(samples, part.error_mean, part.error_square) for part in sums])
    error, size = error_square + n * error_mean**2, square + n * mean**2
    return {
        "value_error": error / max(size, 1e-20 * n),
        "explained_variance": 1.0 - error_square / max(square, 1e-20 * n),
    }
