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


def test_interval_for_two_paired_proportions_covers_their_difference() -> None:
    random = np.random.default_rng(0)
    for low, high in ((0.05, 0.1), (0.3, 0.6)):
        inside = 0
        for _ in range(1000):
            x, y = random.uniform(size=(2, 64))
            centre, half = share_interval(x < low, y < high)
            inside += abs(centre - (high - low)) < half
        assert 930 <= inside <= 975
    none = np.zeros(30, bool)
    centre, half = share_interval(none, none)
    assert centre == 0.0 and 0.05 < half < 0.07
