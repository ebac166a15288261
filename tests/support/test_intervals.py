import math

import numpy as np
import pytest

from lyceum_warp.support.intervals import mean_interval, share_interval, student_quantile


@pytest.mark.parametrize(
    ("freedom", "quantile"), [(1, 12.7062), (2.5, 3.57465), (4, 2.77645), (30, 2.04227), (1000, 1.96234)]
)
def test_student_quantile_matches_published_values(freedom: float, quantile: float) -> None:
    assert student_quantile(0.975, freedom) == pytest.approx(quantile, rel=2e-5)


def test_confidence_interval_of_the_mean_matches_the_t_distribution() -> None:
    mean, half = mean_interval([1.0, 2.0, 3.0, 4.0, 5.0])
    assert (mean, half) == pytest.approx((3.0, 2.77645 * math.sqrt(2.5 / 5)), rel=1e-5)
    assert math.isnan(mean_interval([1.0])[1])


@pytest.mark.parametrize("pairs", [30, 1000])
def test_interval_for_equal_outcomes_has_a_width(pairs: int) -> None:
    for outcomes in (np.zeros(pairs, bool), np.ones(pairs, bool)):
        low, high = share_interval(outcomes, outcomes)
        assert high == -low == pytest.approx(1.0 - 0.05 ** (1.0 / pairs))
    low, high = share_interval(np.zeros(pairs, bool), np.ones(pairs, bool))
    assert 0.8 < low < 1.0 and high == pytest.approx(1.0)
