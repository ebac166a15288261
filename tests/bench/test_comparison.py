import comparison
import numpy as np
import pytest


def test_permutation_test_finds_curves_that_differ() -> None:
    random = np.random.default_rng(1)
    noise = random.normal(size=(2, 5, 10))
    assert comparison.permutation_test(noise[0], noise[1] + 8.0) == pytest.approx(2 / 252)
    assert (comparison.permutation_test(noise[0], noise[0] + 0.01 * noise[1]) > 0.5).all()
    assert np.isnan(comparison.permutation_test(noise[0][:1], noise[1])).all()


def test_false_positive_rate_of_the_permutation_test_equals_the_significance_level() -> None:
    random = np.random.default_rng(0)
    wrong = sum(
        (comparison.permutation_test(*random.normal(size=(2, 4, 6)).cumsum(-1)) < 0.05).any() for _ in range(200)
    )
    assert wrong <= 20
