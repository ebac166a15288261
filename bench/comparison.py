"""Compare two sets of learning curves by a permutation test."""

import itertools
import math

import numpy as np

MOST_SPLITS = 20_000
"""Maximum number of permutations in a permutation test."""


def permutation_test(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Test at every point whether the curves a and b have the same distribution.

    The test permutes whole curves, and compares each point's Welch statistic with the largest statistic over all points
    (Westfall and Young 1993, single step). With few curves, the p-values cannot be small: ten curves can be split in
    only 252 ways.

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
    # the tolerance allows for rounding
    return (largest[:, None] >= observed * (1.0 - 1e-9)).mean(axis=0)


def _welch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    spread = a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b)
    return np.abs(a.mean(axis=0) - b.mean(axis=0)) / np.sqrt(np.maximum(spread, 1e-300))
