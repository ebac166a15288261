"""Compute confidence intervals of means and of differences between paired proportions."""

import functools
import math
from collections.abc import Sequence

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

    low, high = 0.0, 0.5 * math.pi
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if beyond_half(middle) < probability - 0.5 else (low, middle)
    return math.sqrt(freedom) * math.tan(low)


def mean_interval(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Compute the mean and the half-width of its 95 % confidence interval (Student's t); NaN for a single value."""
    array = np.asarray(values, float)
    if len(array) < 2:
        return float(array.mean()), math.nan
    quantile = student_quantile(0.975, len(array) - 1)
    return float(array.mean()), quantile * float(array.std(ddof=1)) / math.sqrt(len(array))


def share_interval(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Compute the difference of two paired proportions, with its 95 % confidence interval.

    Source: Agresti and Min (2005), "Simple improved confidence intervals for comparing matched proportions". A pair has
    four possible outcomes. The method adds 0.5 to the count of each. The width is thus positive even if all pairs
    agree.

    Args:
        first: First outcome of each pair, (pairs,) bool.
        second: Second outcome of each pair, (pairs,) bool.

    Returns:
        The estimated difference, second minus first, and the half-width of the interval.
    """
    gained, lost = (np.count_nonzero(~first & second) + 0.5, np.count_nonzero(first & ~second) + 0.5)
    pairs = len(first) + 2.0
    width = math.sqrt(gained + lost - (gained - lost) ** 2 / pairs) / pairs
    return (gained - lost) / pairs, 1.959964 * width
