"""Compute statistics of learning curves: means with intervals, and a test that compares two sets of curves."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

MOST_SPLITS = 20_000
"""Maximum number of splits of the seeds in the permutation test; if there are more, a random subset is used."""


def student_quantile(probability: float, freedom: float) -> float:
    """Return a quantile of Student's t distribution, by bisection on the integral of its density.

    Args:
        probability: At least 0.5.
        freedom: Degrees of freedom.
    """
    log_factor = math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2) - 0.5 * math.log(freedom * math.pi)
    # with x = sqrt(freedom) tan(angle) the integral is over a finite interval and its integrand is smooth
    nodes, weights = np.polynomial.legendre.leggauss(64)

    def beyond_half(angle: float) -> float:
        at = 0.5 * angle * (nodes + 1.0)
        density = math.sqrt(freedom) * np.exp(log_factor) * np.cos(at) ** (freedom - 1)
        return 0.5 * angle * float(weights @ density)

    low, high = 0.0, 0.5 * math.pi
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if beyond_half(middle) < probability - 0.5 else (low, middle)
    return math.sqrt(freedom) * math.tan(low)


def mean_interval(values: Sequence[float], confidence: float = 0.95) -> tuple[float, float]:
    """Return the mean and the half-width of its confidence interval (Student's t); nan for a single value."""
    array = np.asarray(values, float)
    if len(array) < 2:
        return float(array.mean()), math.nan
    quantile = student_quantile(0.5 + confidence / 2, len(array) - 1)
    return float(array.mean()), quantile * float(array.std(ddof=1)) / math.sqrt(len(array))


def permutation_test(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Test at every point whether the curves a and b have the same distribution, adjusted for all points.

    The test permutes whole curves, and compares each point's Welch statistic with the largest statistic over all points
    (Westfall and Young 1993, single step). The probability of a false positive at any point is therefore at most the
    level, whatever the dependence between points. With few curves the p-values cannot be small: five against five have
    252 splits.

    Args:
        a: Curves, (curves, points).
        b: Curves, (curves, points).

    Returns:
        Adjusted two-sided p-values, (points,); nan with fewer than two curves in a or b.
    """
    both, n = np.concatenate([a, b]), len(a)
    if min(n, len(b)) < 2:
        return np.full(a.shape[1], math.nan)
    if math.comb(len(both), n) <= MOST_SPLITS:
        splits = np.array(list(itertools.combinations(range(len(both)), n)))
    else:
        random = np.random.default_rng(0)
        drawn = [random.permutation(len(both))[:n] for _ in range(MOST_SPLITS - 1)]
        splits = np.array([np.arange(n), *drawn])
    chosen = np.zeros((len(splits), len(both)), bool)
    np.put_along_axis(chosen, splits, True, axis=1)
    statistics = np.stack([_welch(both[first], both[~first]) for first in chosen])
    observed = _welch(a, b)
    largest = statistics.max(axis=1)
    # the observed split is one of them, and must not count as smaller than itself because of rounding
    return (largest[:, None] >= observed * (1.0 - 1e-9)).mean(axis=0)


def _welch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the absolute Welch statistics of all points, (points,)."""
    spread = a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b)
    return np.abs(a.mean(axis=0) - b.mean(axis=0)) / np.sqrt(np.maximum(spread, 1e-300))
