import math
from typing import Any

import numpy as np
import pytest

from lyceum_warp.tuning import Difference
from lyceum_warp.tuning.judgement import difference, episodes_needed, failures, verdict


def test_interval_covers_the_difference_of_returns_and_shrinks_with_more_episodes() -> None:
    rng = np.random.default_rng(1)
    reference = rng.normal(-100.0, 10.0, 2000)
    returns = reference + rng.normal(3.0, 20.0, 2000)
    few, many = difference(reference[:200], returns[:200]), difference(reference, returns)
    assert few.low < 0.03 < few.high and many.low < 0.03 < many.high  # 3 of 100
    assert many.high - many.low == pytest.approx((few.high - few.low) / math.sqrt(10), rel=0.3)
    assert many.mean == pytest.approx((returns - reference).mean() / np.abs(reference).mean())
    assert episodes_needed(few, (many.high - many.low) / 2) == pytest.approx(2000, rel=0.5)


def test_difference_of_equal_returns_is_zero_even_if_all_returns_are_zero() -> None:
    for returns in (np.zeros(5), np.arange(5.0)):
        assert difference(returns, returns) == Difference(0.0, 0.0, 0.0, 5)


def test_reference_returns_of_zero_give_no_verdict() -> None:
    found = difference(np.zeros(5), np.arange(5.0))
    assert not found.within(0.05) and not found.beyond(0.05)


def test_a_true_loss_of_2_percent_by_rare_failures_is_seldom_called_the_same() -> None:
    rng = np.random.default_rng(0)
    for pairs in (256, 512):
        same = {"mean": 0, "both": 0}
        for _ in range(1000):
            reference, returns = np.ones(pairs), 1.0 - (rng.random(pairs) < 0.02)
            mean = difference(reference, returns).within(0.02)
            same = {
                "mean": same["mean"] + mean,
                "both": same["both"] + (mean and failures(reference, returns).within(0.02)),
            }
        assert same["both"] <= 45 < same["mean"]  # nominal: 25


def test_failures_of_the_unchanged_task_are_subtracted() -> None:
    reference, returns = np.ones(1000), np.ones(1000)
    reference[:3], returns[3:10] = 0.0, 0.0
    found = failures(reference, returns)
    assert found.mean == pytest.approx(0.004) and -0.003 < found.low < 0.0 < found.high < 0.012


def row(*bounds: tuple[float, float], **entries: Any) -> dict[str, Any]:
    returns = {str(i): {"mean": 0.0, "low": low, "high": high, "episodes": 9} for i, (low, high) in enumerate(bounds)}
    known = {"refused": "", "speedup": 2.0, "speedup_low": 1.9, "memory": 1.0, "faults_per_million": 0.0}
    return {**known, "reference_faults_per_million": 0.0, "returns": returns, **entries}


@pytest.mark.parametrize(
    ("found", "wanted"),
    [
        (row((-0.01, 0.02), (0.0, 0.0)), "same"),
        (row((-0.01, 0.03), (0.0, 0.0)), "not shown"),
        (row((-0.01, 0.02), (0.03, 0.04)), "different"),
        (row((-0.05, -0.03)), "different"),
        (row((0.0, 0.0), speedup_low=1.01), "no gain"),
        (row((0.0, 0.0), speedup_low=1.01, memory=0.6), "same"),
        (row((0.0, 0.0), faults_per_million=3.0, reference_faults_per_million=1.0), "faults"),
        (row((0.0, 0.0), faults_per_million=3.0, reference_faults_per_million=2.0), "same"),
        (
            row((0.0, 0.0), clearly_worse={"random": {"mean": 0.0, "low": 0.0, "high": 0.03, "episodes": 9}}),
            "not shown",
        ),
        ({"refused": "MuJoCo refuses it"}, "refused"),
    ],
)
def test_verdict_depends_on_the_intervals_of_the_returns(found: dict[str, Any], wanted: str) -> None:
    assert verdict(found, "strict") == wanted


def test_looser_tolerance_accepts_larger_differences() -> None:
    found = row((-0.04, 0.01))
    assert verdict(found, "strict") == "not shown"
    assert verdict(found, "loose") == verdict(row((1.0, 2.0)), "any") == "same"
