import numpy as np
import pytest
import torch
import warp as wp

import lyceum_warp as lw
from lyceum_warp import MPPI, Row
from lyceum_warp.kernels import planning


@pytest.fixture(scope="module")
def many() -> MPPI:
    """Make a planner with little noise, so that no action is clipped."""
    return MPPI("point_mass", horizon=8, samples=4000, noise=[0.02, 0.05], temperature=1e9)


def test_noise_is_standard_normal_and_independent(many: MPPI) -> None:
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
    assert np.abs(correlation).max() < 5 / np.sqrt(4000), "steps, actions, plans or seeds are correlated"
    for lag in (1, 2, 3, 17, 2000):
        for one, other in ((0, 0), (0, 1), (0, 2), (2, 0)):
            product = (draws[one][lag:] * draws[other][:-lag]).mean()
            assert abs(product) < 5 / np.sqrt(16 * (4000 - lag)), f"samples {lag} apart are correlated"


def test_noise_of_a_sample_does_not_depend_on_the_number_of_samples() -> None:
    few, more = (MPPI("point_mass", horizon=6, samples=n, seed=2) for n in (8, 50))
    for _ in range(3):
        few(few.state_of()), more(more.state_of())
        assert torch.equal(few.standard_noise, more.standard_noise[:, :8])


@pytest.mark.parametrize("temperature", [1e-6, 1e-30])
def test_plan_with_low_temperature_equals_the_best_sample(temperature: float) -> None:
    plan = MPPI("reach", temperature=temperature)
    plan(lw.make("reach", seed=0).get_state()[0])
    best = plan.returns.argmax()
    assert plan.weights[best] == 1 and plan.weights.sum() == 1
    assert torch.equal(plan.actions, plan.sampled[:, best])
    assert plan.summary["effective_samples"] == pytest.approx(1)


@pytest.mark.parametrize("temperature", [1e9, 1e60])
def test_plan_with_high_temperature_is_the_mean_of_all_samples(temperature: float) -> None:
    plan = MPPI("reach", temperature=temperature)
    plan(lw.make("reach", seed=0).get_state()[0])
    torch.testing.assert_close(plan.actions, plan.sampled.mean(1))
    assert plan.summary["effective_samples"] == pytest.approx(plan.samples)


@wp.func
def value_of_two(obs: Row[float], step: float) -> float:
    return obs[0] + step


@wp.func
def value_of_whole_numbers(obs: Row[int]) -> float:
    return float(obs[0])


@pytest.mark.parametrize("value", [value_of_two, value_of_whole_numbers], ids=["two arguments", "int"])
def test_warp_value_function_with_wrong_arguments_raises_an_error(value: wp.Function) -> None:
    with pytest.raises(ValueError, match=r"must be written as value\(obs: Row\[float\]\) -> float"):
        planning.value_kernel(value)
