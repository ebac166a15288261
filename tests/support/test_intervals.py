import math

import numpy as np
import pytest

from lyceum_warp.support.intervals import clear_losses, mean_interval, share_interval, student_quantile


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
    for low, high in ((0.05, 0.1), (0.3, 0.6), (0.0, 0.05)):
        above, below = 0, 0
        for _ in range(1000):
            x, y = random.uniform(size=(2, 64))
            bounds = share_interval(x < low, y < high)
            above, below = above + (bounds[0] > high - low), below + (bounds[1] < high - low)
        assert above <= 45 and below <= 45 and above + below >= 10  # nominal: 25 each


@pytest.mark.parametrize("pairs", [30, 1000])
def test_interval_for_equal_outcomes_has_a_width(pairs: int) -> None:
    for outcomes in (np.zeros(pairs, bool), np.ones(pairs, bool)):
        low, high = share_interval(outcomes, outcomes)
        assert high == -low == pytest.approx(1.0 - 0.05 ** (1.0 / pairs))
    low, high = share_interval(np.zeros(pairs, bool), np.ones(pairs, bool))
    assert 0.8 < low < 1.0 and high == pytest.approx(1.0)


def test_only_changes_far_outside_the_quartiles_are_clear() -> None:
    first = np.random.default_rng(0).normal(100.0, 20.0, 200)
    second = first + np.random.default_rng(1).normal(-4.0, 1.0, 200)  # every pair changes by about -4
    assert not np.any(clear_losses(first, second, 5.0))
    second[:3], second[3] = second[:3] - 20.0, second[3] + 20.0
    one, other = clear_losses(first, second, 5.0)
    assert np.flatnonzero(one).tolist() == [3] and np.flatnonzero(other).tolist() == [0, 1, 2]
