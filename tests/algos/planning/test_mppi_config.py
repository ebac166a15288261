import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch

import lyceum_warp as lw
from lyceum_warp import MPPI, MPPIConfig
from lyceum_warp.binding import find_task
from lyceum_warp.core import Space


@pytest.mark.parametrize(
    ("name", "wrong", "message"),
    [
        ("horizon", [0, -1, 2.5, "a", math.nan, None], "horizon must be a whole number from 1"),
        ("samples", [0, -1, 2.5, "a", math.inf], "samples must be a whole number from 1"),
        ("iterations", [0, -1, 2.5, "a"], "iterations must be a whole number from 1"),
        ("temperature", [0, -1, math.nan, math.inf, "a", "0.5", True, None, 1e-60],
         "temperature must be a finite number of at least 1.17549e-38"),
        ("discount", [2, -0.1, math.nan, "a", True], "discount must be a finite number from 0 to 1"),
        ("noise", [-1, math.nan, math.inf, [1, -1], [], [[1, 2], [2, 1]], [[1, 0.5], [0.2, 1]], np.ones((2, 3)), "a",
                   [1, [2, 3]], None, True], "noise must be a standard deviation, a standard deviation for"),
        ("smoothing", [(1, 0), 1, (1, 0, math.nan), "abc", [1, [2, 3], 4], None], "smoothing must be 3 finite numbers"),
        ("fill", ["x", [1, math.nan], ["a", "b"], [[1.0]], [], None, math.inf], "fill must be 'zero', 'repeat' or"),
        ("termination", ["x", True, 3, ["stop"]], "termination must be 'stop' or 'ignore'"),
        ("update", ["x", True, None, ["cem"]], "update must be 'mppi', 'cem' or 'predictive_sampling'"),
        ("elites", [0, -1, 2.5, "a"], "elites must be a whole number from 1"),
        ("elites", [65], "elites=65 must be at most samples, which is 64"),
        ("min_noise", [-1, math.nan, [1, -1], [], [[1.0]], "a", True], "min_noise must be a standard deviation, or"),
        ("include_plan", [1, "yes"], "include_plan must be True or False"),
        ("knots", [0, 2.5, "a"], "knots must be a whole number from 1"),
        ("knots", [33], "knots=33 must be at most horizon, which is 32"),
        ("spline", ["quintic", 3, None], "spline must be 'zero', 'linear' or 'cubic'"),
        ("spline", ["zero"], "spline='zero' interpolates between knots: give the number of knots"),
        ("models", [0, -1, 2.5, "a", None], "models must be a whole number from 1"),
        ("risk", ["x", True, None], "risk must be 'mean' or 'worst'"),
        ("risk", ["worst"], "risk='worst' compares models: give the number of models"),
        ("nominal_model", [1, "yes", None], "nominal_model must be True or False"),
    ],
)  # fmt: skip
def test_error_of_a_setting_out_of_range_names_the_setting(name: str, wrong: list[Any], message: str) -> None:
    for value in wrong:
        with pytest.raises(ValueError, match=message):
            MPPIConfig(**{name: value})
            pytest.fail(f"{name}={value!r} was accepted")


def test_random_models_and_nominal_model_together_raise_an_error() -> None:
    with pytest.raises(ValueError, match="models=4 needs random model fields, but nominal_model=True uses nominal"):
        MPPIConfig(models=4, nominal_model=True)


@pytest.mark.parametrize("smoothing, stable", [
    *((betas, False) for betas in ((0.25, 0.8, 0.3), (1, 1, 0), (1, 0, 1), (1, 0, -1), (1, -1.5, 0), (1, 1.9, -1))),
    *((betas, True) for betas in ((1, 0, 0), (0.5, 0.3, 0.2), (5, 1.9, -0.95), (1, -0.9, 0), (1, 0, 0.99))),
])  # fmt: skip
def test_smoothing_with_poles_outside_the_unit_circle_raises_an_error(smoothing: Any, stable: bool) -> None:
    assert (max(abs(np.roots([1, -smoothing[1], -smoothing[2]]))) < 1 - 1e-12) == stable
    if stable:
        assert MPPIConfig(smoothing=smoothing).smoothing == smoothing
        return
    with pytest.raises(ValueError, match=r"smoothing .* is unstable: .* \|b2\| < 1 and \|b1\| < 1 - b2"):
        MPPIConfig(smoothing=smoothing)


def test_arrays_and_tensors_are_converted_to_tuples_of_floats() -> None:
    config = MPPIConfig(
        horizon=np.int64(3), noise=torch.eye(2), smoothing=[1, 0, 0], fill=np.array([1, 2])  # type: ignore[arg-type]
    )  # fmt: skip
    assert (config.horizon, config.noise, config.smoothing, config.fill) == (
        3, ((1.0, 0.0), (0.0, 1.0)), (1.0, 0.0, 0.0), (1.0, 2.0)
    )  # fmt: skip
    assert hash(config) == hash(dataclasses.replace(config))


@pytest.mark.parametrize("name, value, message", [
    ("noise", [1, 2, 3], r"noise must be a standard deviation, 2 standard deviations, or a positive definite"),
    ("noise", np.eye(3), r"noise must be a standard deviation, 2 standard deviations, or a positive definite"),
    ("fill", [1], r"fill must be 'zero', 'repeat', a number or 2 numbers, not \(1.0,"),
])  # fmt: skip
def test_settings_for_a_different_action_size_raise_an_error(name: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MPPI("point_mass", horizon=3, samples=4, **{name: value})


def test_fill_action_is_clipped_to_the_action_bounds() -> None:
    low, high = np.array([-1.0, 0.2]), np.array([1.0, 0.4])
    space = dataclasses.replace(MPPI("point_mass", samples=1).env.action_space, low=low, high=high)
    assert isinstance(space, Space)
    for fill, action in (("zero", [0, 0.2]), ("repeat", [0, 0.2]), (0.3, [0.3, 0.3]), ([-5, 5], [-1, 0.4])):
        np.testing.assert_array_equal(MPPIConfig(fill=fill).fill_action(space), action)


@pytest.mark.quick("adroit_pen", "cartpole_swingup", "hopper", "humanoid_get_up", "reach")
@pytest.mark.parametrize("task", [name for name in lw.task_names() if find_task(name).planning != lw.Planning()])
def test_every_task_can_plan_with_its_own_settings(task: str) -> None:
    plan = lw.MPPI(task, horizon=12, samples=4)
    plan.env.rand_reset(0)
    action = plan(plan.env.get_state()[0])
    assert torch.isfinite(action).all() and action.abs().max() > 0.0
