"""The noise that MPPI varies its plans with, against its formulas."""

import numpy as np
import pytest
import torch
from test_mppi import smoothed

from lyceum_warp import MPPI


@pytest.fixture(scope="module")
def many() -> MPPI:
    """Many samples of little noise, which bounds never touch."""
    return MPPI("point_mass", horizon=8, samples=4000, noise=[0.02, 0.05], temperature=1e9)


def test_noise_is_standard_normal_and_independent(many: MPPI) -> None:
    """Of steps, actuators, samples, plans and seeds."""
    many.reset(0)
    draws = []
    for seed in (0, 0, 1):
        if seed:
            many.reset(seed)
        many(many.state_of())
        draws.append(many.standard_noise.permute(1, 0, 2).reshape(4000, 16).double().numpy())
    numbers = np.hstack(draws)
    assert abs(numbers.mean()) < 4 / np.sqrt(numbers.size)
    assert np.abs(numbers.mean(0)).max() < 4.5 / np.sqrt(4000)
    np.testing.assert_allclose(numbers.std(0), 1, atol=4.5 / np.sqrt(2 * 4000))
    np.testing.assert_allclose((numbers**4).mean(), 3, atol=0.1)
    for k, share in ((1, 0.6827), (2, 0.9545), (3, 0.9973)):
        np.testing.assert_allclose((np.abs(numbers) < k).mean(), share, atol=0.004)
    correlation = np.corrcoef(numbers.T) - np.eye(48)
    assert np.abs(correlation).max() < 5 / np.sqrt(4000), "steps, actuators, plans or seeds are correlated"
    for lag in (1, 2, 3, 17, 2000):
        for one, other in ((0, 0), (0, 1), (0, 2), (2, 0)):
            product = (draws[one][lag:] * draws[other][:-lag]).mean()
            assert abs(product) < 5 / np.sqrt(16 * (4000 - lag)), f"samples {lag} apart are correlated"


@pytest.mark.parametrize("betas", [(0.25, 0.8, 0.0), (1.0, 0.0, 0.0), (0.5, 0.3, 0.2)])
def test_smoothed_noise_has_the_spread_of_the_formula(betas: tuple[float, float, float]) -> None:
    """1, 1, 0.838, 0.716, ... of what was asked for, with the original's numbers."""
    plan = MPPI("point_mass", horizon=12, samples=4000, noise=[0.02, 0.05], smoothing=betas)
    plan(plan.state_of())
    added = (plan.sampled - plan.nominal[:, None]).double().numpy()
    answers = smoothed(np.eye(12), betas)  # the answer of every step to an impulse at every other
    spread = np.sqrt((answers**2).sum(1))[:, None] * [0.02, 0.05]
    np.testing.assert_allclose(added.std(1), spread, rtol=0.05)
    correlation = answers @ answers.T / np.sqrt(np.outer((answers**2).sum(1), (answers**2).sum(1)))
    for i in range(2):
        np.testing.assert_allclose(np.corrcoef(added[:, :, i]), correlation, atol=0.08)
    assert betas != (0.25, 0.8, 0.0) or spread[2, 0] == pytest.approx(0.02 * np.sqrt(0.25**2 + 0.8**2))


def test_noise_has_the_covariance_that_was_asked_for() -> None:
    wanted = 1e-3 * np.array([[1.0, -0.6], [-0.6, 0.5]])
    plan = MPPI("point_mass", horizon=10, samples=4000, noise=wanted, smoothing=(1, 0, 0))
    plan(plan.state_of())
    added = (plan.sampled - plan.nominal[:, None]).double().numpy().reshape(-1, 2)
    np.testing.assert_allclose(np.cov(added.T), wanted, atol=3e-5)
    # standard deviations, one number and a diagonal covariance ask for the same
    plans = [MPPI("point_mass", horizon=10, noise=noise) for noise in (0.1, [0.1, 0.1], np.diag([0.01, 0.01]))]
    for plan in plans:
        plan(plan.state_of())
        torch.testing.assert_close(plan.sampled, plans[0].sampled)


def test_a_samples_noise_does_not_depend_on_how_many_there_are() -> None:
    few, more = (MPPI("point_mass", horizon=6, samples=n, seed=2) for n in (8, 50))
    for _ in range(3):
        few(few.state_of()), more(more.state_of())
        assert torch.equal(few.standard_noise, more.standard_noise[:, :8])
