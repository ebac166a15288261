"""Compute confidence intervals of means and of differences between paired proportions."""

import functools
import math
from collections.abc import Sequence

import numpy as np

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(64)


# a figure has intervals at hundreds of points, most of them of equally many values
@functools.lru_cache(maxsize=256)
def student_quantile(probability: float, freedom: float) -> float:
    """Compute a quantile of Student's t distribution, by bisection on the integral of its density.

    Args:
        probability: At least 0.5.
        freedom: Degrees of freedom.
    """
    log_factor = math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2) - 0.5 * math.log(freedom * math.pi)

    # with x = sqrt(freedom) tan(angle) the integral is over a finite interval and its integrand is smooth
    def beyond_half(angle: float) -> float:
        at = 0.5 * angle * (_NODES + 1.0)
        density = math.sqrt(freedom) * np.exp(log_factor) * np.cos(at) ** (freedom - 1)
        return 0.5 * angle * float(_WEIGHTS @ density)

    low, high = 0.0, 0.5 * math.pi
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if beyond_half(middle) < probability - 0.5 else (low, middle)
    return math.sqrt(freedom) * math.tan(low)


def mean_interval(values: Sequence[float] | np.ndarray, confidence: float = 0.95) -> tuple[float, float]:
    """Compute the mean and the half-width of its confidence interval (Student's t); NaN for a single value."""
    array = np.asarray(values, float)
    if len(array) < 2:
        return float(array.mean()), math.nan
    quantile = student_quantile(0.5 + confidence / 2, len(array) - 1)
    return float(array.mean()), quantile * float(array.std(ddof=1)) / math.sqrt(len(array))


def share_interval(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Compute the difference of two paired proportions, and the half-width of its 95 % confidence interval.

    Half an observation is added to each of the four outcomes of a pair (Agresti and Min 2005, "Simple improved
    confidence intervals for comparing matched proportions"), so that the interval has a width if all pairs agree.

    Args:
        first: Whether something happened in each pair, (pairs,) bool.
        second: The same for the other member of each pair.

    Returns:
        The difference, second minus first, at the centre of the interval, and the half-width.
    """
    gained, lost = (np.count_nonzero(~first & second) + 0.5, np.count_nonzero(first & ~second) + 0.5)
    pairs = len(first) + 2.0
    width = math.sqrt(gained + lost - (gained - lost) ** 2 / pairs) / pairs
    return (gained - lost) / pairs, 1.959964 * width
