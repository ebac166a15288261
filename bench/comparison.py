"""Statistics of learning curves: means with intervals, and whether two sets of curves differ at given points."""

import itertools
import math
from collections.abc import Sequence

import numpy as np

MOST_SPLITS = 20_000
"""Splits of the seeds that the permutation test looks at; where there are more, it draws so many."""


def student_quantile(probability: float, freedom: float) -> float:
    """Quantile of Student's t distribution, by bisection on the integral of its density.

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
    """Mean, and half the width of its confidence interval (Student's t); nan for the width of a single value."""
    array = np.asarray(values, float)
    if len(array) < 2:
        return float(array.mean()), math.nan
    quantile = student_quantile(0.5 + confidence / 2, len(array) - 1)
    return float(array.mean()), quantile * float(array.std(ddof=1)) / math.sqrt(len(array))


def difference_interval(a: Sequence[float], b: Sequence[float], confidence: float = 0.95) -> tuple[float, float]:
    """Difference of the means of a and b, and half the width of its confidence interval (Welch 1947)."""
    difference = float(np.mean(a) - np.mean(b))
    if min(len(a), len(b)) < 2:
        return difference, math.nan
    parts = [float(np.var(values, ddof=1)) / len(values) for values in (a, b)]
    if sum(parts) == 0.0:
        return difference, 0.0
    freedom = sum(parts) ** 2 / sum(part**2 / (len(v) - 1) for part, v in zip(parts, (a, b), strict=True))
    return difference, student_quantile(0.5 + confidence / 2, freedom) * math.sqrt(sum(parts))


def permutation_test(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Two-sided p values at every point that the curves a and b have the same distribution, adjusted for all points.

    The test permutes whole curves, and compares each point's Welch statistic with the largest one of all points
    (Westfall and Young 1993, single step), so that the probability of an error at any point is at most the level, with
    any dependence between the points. With few curves the p values cannot be small: five against five have 252 splits.

    Args:
        a: Curves, (curves, points).
        b: Curves, (curves, points).

    Returns:
        Adjusted p values, (points,); nan with fewer than two curves in a or b.
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
    # the observed split is among them; rounding must not count it as smaller than itself
    return (largest[:, None] >= observed * (1.0 - 1e-9)).mean(axis=0)


def _welch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Absolute Welch statistics of all points, (points,)."""
    spread = a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b)
    return np.abs(a.mean(axis=0) - b.mean(axis=0)) / np.sqrt(np.maximum(spread, 1e-300))
