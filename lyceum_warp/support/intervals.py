"""Compute confidence intervals of means and of differences between paired proportions."""

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


# a figure shows hundreds of intervals with the same degrees of freedom
@functools.lru_cache(maxsize=256)
def student_quantile(probability: float, freedom: float) -> float:
    """Compute a quantile of Student's t distribution by bisection on the integral of its density.

    Args:
        probability: A number of at least 0.5.
        freedom: The number of degrees of freedom.
    """
    log_factor = math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2) - 0.5 * math.log(freedom * math.pi)

    # substitute x = sqrt(freedom) tan(angle) for a smooth integrand on a finite interval
    def beyond_half(angle: float) -> float:
        at = 0.5 * angle * (_NODES + 1.0)
        density = math.sqrt(freedom) * np.exp(log_factor) * np.cos(at) ** (freedom - 1)
        return 0.5 * angle * float(_WEIGHTS @ density)

    return math.sqrt(freedom) * math.tan(_root(lambda angle: beyond_half(angle) - probability + 0.5, 0.5 * math.pi))


def mean_interval(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Compute the mean and the half-width of its 95 % confidence interval (Student's t); NaN for a single value."""
    array = np.asarray(values, float)
    if len(array) < 2:
        return float(array.mean()), math.nan
    quantile = student_quantile(0.975, len(array) - 1)
    return float(array.mean()), quantile * float(array.std(ddof=1)) / math.sqrt(len(array))


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Compute the mean of the middle half of the values along the last axis.

    A quarter of the values, rounded down, is left out at either end (Agarwal et al. 2021, "Deep reinforcement learning
    at the edge of the statistical precipice").
    """
    left_out = values.shape[-1] // 4
    return np.sort(values, axis=-1)[..., left_out : values.shape[-1] - left_out].mean(-1)


def bootstrap_interval(
    values: Sequence[float] | np.ndarray, statistic: Callable[[np.ndarray], np.ndarray], *, resamples: int = 10_000
) -> np.ndarray:
    """Compute the 95 % percentile bootstrap interval of a statistic of each row; NaN for rows of a single value.

    The resamples have a fixed seed, and are the same for all rows. The interval of few values is too narrow (Efron and
    Tibshirani 1993, "An introduction to the bootstrap", chapter 13).

    Args:
        values: The values, (..., n).
        statistic: Maps arrays (..., resamples, n) to (..., resamples).
        resamples: Number of resamples with replacement.

    Returns:
        The lower and the upper ends, (2, ...).
    """
    array = np.asarray(values, float)
    n = array.shape[-1]
    if n < 2:
        return np.full((2, *array.shape[:-1]), math.nan)
    index = np.random.default_rng(0).integers(n, size=(resamples, n))
    return np.percentile(statistic(array[..., index]), (2.5, 97.5), axis=-1)


def clear_losses(first: np.ndarray, second: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Find the pairs in which one value is clearly smaller than the other.

    A change is clear if it lies outside the quartiles of all changes by more than ``margin`` plus three interquartile
    ranges. Three interquartile ranges are the fence of values that are "far out" (Tukey 1977, "Exploratory Data
    Analysis"), so changes that all pairs share are not clear.

    Args:
        first: First value of each pair, (pairs,).
        second: Second value of each pair, (pairs,).
        margin: Smallest clear change if most pairs do not change.

    Returns:
        Whether the first value is clearly smaller, and whether the second value is, each (pairs,) bool.
    """
    change = second - first
    low, high = np.percentile(change, (25, 75))
    fence = margin + 3.0 * (high - low)
    return change > high + fence, change < low - fence


def share_interval(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Compute the 95 % confidence interval of the difference of two paired proportions, second minus first.

    Pairs with different outcomes determine the difference: the share with only the second outcome, minus the share with
    only the first. The interval combines the mid-p limits of these two shares (Zou and Donner 2008, "Construction of
    confidence limits about effect measures"). If all of n pairs agree, it is ± (1 - 0.05^(1/n)).

    Args:
        first: First outcome of each pair, (pairs,) bool.
        second: Second outcome of each pair, (pairs,) bool.
    """
    pairs = len(first)
    gained, lost = int((~first & second).sum()), int((first & ~second).sum())
    a, b = gained / pairs, lost / pairs
    (a_low, a_high), (b_low, b_high) = _share_limits(gained, pairs), _share_limits(lost, pairs)
    # the two shares exclude each other, so they are negatively correlated
    correlation = -math.sqrt(a * b / ((1.0 - a) * (1.0 - b))) if max(a, b) < 1.0 else 0.0

    def width(one: float, other: float) -> float:
        return math.sqrt(one**2 + other**2 - 2.0 * correlation * one * other)

    return a - b - width(a - a_low, b_high - b), a - b + width(a_high - a, b - b_low)


@functools.lru_cache(maxsize=4096)
def _share_limits(count: int, pairs: int) -> tuple[float, float]:
    """Compute the mid-p limits (95 %) of a proportion of which ``count`` of ``pairs`` cases were seen."""
    counts = np.arange(count + 1)
    weight = np.where(counts < count, 1.0, 0.5)
    ways = [math.lgamma(pairs + 1) - math.lgamma(k + 1) - math.lgamma(pairs - k + 1) for k in counts]

    def at_most(share: float) -> float:
        return float(weight @ np.exp(ways + counts * math.log(share) + (pairs - counts) * math.log1p(-share)))

    return _root(lambda share: 0.975 - at_most(share), 1.0), _root(lambda share: 0.025 - at_most(share), 1.0)


def _root(increasing: Callable[[float], float], high: float) -> float:
    """Find the zero of an increasing function between 0 and ``high`` by bisection, or the end next to it."""
    low = 0.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if increasing(middle) < 0.0 else (low, middle)
    return low
