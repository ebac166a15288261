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
    ("name", "wrong"),
    [
        ("horizon", [0, 2.5, "a", math.nan, None]),
        ("temperature", [0, -1, math.nan, math.inf, "a", "0.5", True, None, 1e-60]),
        ("discount", [2, -0.1, math.nan, "a", True]),
        ("noise", [-1, math.nan, math.inf, [1, -1], [], [[1, 2], [2, 1]], [[1, 0.5], [0.2, 1]], np.ones((2, 3)), "a",
                   [1, [2, 3]], None, True]),
        ("smoothing", [(1, 0), 1, (1, 0, math.nan), "abc", [1, [2, 3], 4], None]),
        ("fill", ["x", [1, math.nan], ["a", "b"], [[1.0]], [], None, math.inf]),
        ("update", ["x", True, None, ["cem"]]),
        ("elites", [0, 65, "a"]),
        ("min_noise", [-1, math.nan, [1, -1], [], [[1.0]], "a", True]),
        ("include_plan", [1, "yes"]),
        ("knots", [0, 33, "a"]),
        ("spline", ["quintic", 3, None, "zero"]),
        ("risk", ["x", True, None, "worst"]),
    ],
)  # fmt: skip
def test_error_of_a_setting_out_of_range_names_the_setting(name: str, wrong: list[Any]) -> None:
    for value in wrong:
        with pytest.raises(ValueError, match=f"^{name}"):
            MPPIConfig(**{name: value})
            pytest.fail(f"{name}={value!r} was accepted")


def test_random_models_and_nominal_model_together_raise_an_error() -> None:
    with pytest.raises(ValueError, match="models=4 .* nominal_model=True"):
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
    with pytest.raises(ValueError, match="smoothing .* is unstable"):
        MPPIConfig(smoothing=smoothing)


def test_arrays_and_tensors_are_converted_to_tuples_of_floats() -> None:
    config = MPPIConfig(
        horizon=np.int64(3), noise=torch.eye(2), smoothing=[1, 0, 0], fill=np.array([1, 2])  # type: ignore[arg-type]
    )  # fmt: skip
    assert (config.horizon, config.noise, config.smoothing, config.fill) == (
        3, ((1.0, 0.0), (0.0, 1.0)), (1.0, 0.0, 0.0), (1.0, 2.0)
    )  # fmt: skip
    assert hash(config) == hash(dataclasses.replace(config))


@pytest.mark.parametrize("name, value", [("noise", [1, 2, 3]), ("noise", np.eye(3)), ("fill", [1])])
def test_settings_for_a_different_action_size_raise_an_error(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"^{name} .*, not \("):
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
