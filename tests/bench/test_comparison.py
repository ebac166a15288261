import math

import comparison
import numpy as np
import pytest


@pytest.mark.parametrize(
    ("freedom", "quantile"), [(1, 12.7062), (2.5, 3.57465), (4, 2.77645), (30, 2.04227), (1000, 1.96234)]
)
def test_student_quantile_matches_published_values(freedom: float, quantile: float) -> None:
    assert comparison.student_quantile(0.975, freedom) == pytest.approx(quantile, rel=2e-5)


def test_mean_interval_of_five_values() -> None:
    mean, half = comparison.mean_interval([1.0, 2.0, 3.0, 4.0, 5.0])
    assert (mean, half) == pytest.approx((3.0, 2.77645 * math.sqrt(2.5 / 5)), rel=1e-5)
    assert math.isnan(comparison.mean_interval([1.0])[1])


def test_permutation_test_finds_curves_that_differ() -> None:
    random = np.random.default_rng(1)
    noise = random.normal(size=(2, 5, 10))
    assert comparison.permutation_test(noise[0], noise[1] + 8.0) == pytest.approx(2 / 252)
    assert (comparison.permutation_test(noise[0], noise[0] + 0.01 * noise[1]) > 0.5).all()
    assert np.isnan(comparison.permutation_test(noise[0][:1], noise[1])).all()


def test_permutation_test_holds_its_level_over_all_points() -> None:
    random = np.random.default_rng(0)
    wrong = sum(
        (comparison.permutation_test(*random.normal(size=(2, 4, 6)).cumsum(-1)) < 0.05).any() for _ in range(200)
    )
    assert wrong <= 20
