"""Decide by confidence intervals whether a physics setting changes the returns too much."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from lyceum_warp.support.intervals import clear_losses, mean_interval, share_interval

TOLERANCES = {"strict": 0.02, "loose": 0.05, "any": math.inf}
"""Largest accepted difference of returns, relative to the unchanged task's mean absolute return."""

RANK_CORRELATIONS = {"strict": 0.9, "loose": 0.8, "any": -1.0}
"""Smallest accepted rank correlation between returns under the planner's physics and returns under the plant's physics;
see bench/results/planning.md."""

LEAST_GAIN = 1.03
"""Returns are compared only if a setting reaches this speed-up or takes less memory."""
_LEAST_SAVING = 0.95


@dataclasses.dataclass(frozen=True)
class Difference:
    """How much a setting changes the mean return, relative to the unchanged task's mean absolute return.

    For ``failures``, it is how much the setting changes the fraction of clearly worse episodes.
    """

    mean: float
    low: float
    high: float
    """Bounds of the 95 % confidence interval."""
    episodes: int

    def within(self, tolerance: float) -> bool:
        """Return whether the interval lies within the tolerance."""
        return -tolerance <= self.low and self.high <= tolerance

    def beyond(self, tolerance: float) -> bool:
        """Return whether the interval lies outside the tolerance."""
        return self.low > tolerance or self.high < -tolerance

    def __str__(self) -> str:
        return f"[{100 * self.low:+.1f}, {100 * self.high:+.1f}]"


def difference(reference: np.ndarray, returns: np.ndarray) -> Difference:
    """Compare returns of the same episodes, each (episodes,)."""
    change, scale = returns - reference, float(np.abs(reference).mean())
    if not change.any():
        return Difference(0.0, 0.0, 0.0, len(change))
    if not scale:
        return Difference(math.inf, -math.inf, math.inf, len(change))
    mean, half = mean_interval(change / scale)
    return Difference(mean, mean - half, mean + half, len(change))


def failures(reference: np.ndarray, returns: np.ndarray) -> Difference:
    """Compare how many of the same episodes are clearly worse than the other episode of their pair.

    Failures that do not end an episode may be too rare for the interval of the mean return. A return is clearly lower
    if it differs by more than 2 % of the unchanged task's mean absolute return plus three interquartile ranges of all
    differences. The result is the fraction of pairs in which the setting is clearly worse, minus the fraction in which
    the unchanged task is.
    """
    first, second = clear_losses(reference, returns, TOLERANCES["strict"] * float(np.abs(reference).mean()))
    low, high = share_interval(first, second)
    return Difference(float(second.mean() - first.mean()), low, high, len(returns))


def episodes_needed(difference: Difference, half_width: float) -> int:
    """Estimate how many episodes give an interval of a given half-width.

    It uses only the spread of the returns, and thus does not depend on the result (Stein's two-stage procedure).
    """
    ratio = (difference.high - difference.low) / 2 / half_width
    return difference.episodes if ratio <= 1.0 else math.ceil(min(difference.episodes * ratio**2, 1e9))


def buys(speedup: float, memory: float) -> bool:
    """Decide whether a setting saves time or memory, given the speed-up's lower bound and the ratio of memory."""
    return speedup >= LEAST_GAIN or memory <= _LEAST_SAVING


def verdict(row: Mapping[str, Any], tolerance: str) -> str:
    """Return the verdict on a row of results; see ``Tuning.rows``.

    Rows of tasks with terminations have no fraction of clearly worse episodes.
    """
    if row["refused"]:
        return "refused"
    if "ranks" in row:
        return _verdict_on_ranks(row, RANK_CORRELATIONS[tolerance])
    if not buys(row["speedup_low"], row["memory"]):
        return "no gain"
    if row["faults_per_million"] > 2 * row["reference_faults_per_million"]:
        return "faults"
    limit = TOLERANCES[tolerance]
    differences = [Difference(**part) for name in ("returns", "clearly_worse") for part in row.get(name, {}).values()]
    if all(difference.within(limit) for difference in differences):
        return "same"
    return "different" if any(difference.beyond(limit) for difference in differences) else "not shown"


def _verdict_on_ranks(row: Mapping[str, Any], least: float) -> str:
    intervals = list(row["ranks"].values())
    if any(interval["high"] < least for interval in intervals):
        return "ranks badly"
    if row["speedup"] < LEAST_GAIN:
        return "no gain"
    return "same" if intervals and all(interval["low"] >= least for interval in intervals) else "not shown"
