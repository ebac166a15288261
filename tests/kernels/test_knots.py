import numpy as np
import pytest
import warp as wp
from plain_mppi import Grid

from lyceum_warp.kernels import knots

SPLINES = ["zero", "linear", "cubic"]


def interpolated(
    values: np.ndarray, horizon: int, count: int, spline: str, phase: int = 0, models: int = 1, limit: float = np.inf
) -> np.ndarray:
    _, samples, nact = values.shape
    out = wp.zeros((horizon, samples * models, nact), dtype=float, device="cpu")
    bounds = [wp.array(np.full(nact, sign * limit), dtype=float, device="cpu") for sign in (-1, 1)]
    phases = wp.array([phase], dtype=int, device="cpu")
    args = [wp.array(values, dtype=float, device="cpu"), phases, count, knots.ORDERS[spline], *bounds, out]
    wp.launch(knots.interpolate, out.shape, args, device="cpu")
    return out.numpy()


@pytest.mark.parametrize("spline", SPLINES)
@pytest.mark.parametrize("horizon, count", [(12, 4), (13, 4), (7, 5), (5, 5), (9, 1)])
def test_interpolated_actions_equal_the_numpy_implementation_at_every_phase(
    horizon: int, count: int, spline: str
) -> None:
    number = knots.knot_count(horizon, count, spline)
    values = np.random.default_rng(1).normal(size=(number, 3, 2)).astype(np.float32)
    grid = Grid(horizon, count, spline)
    for grid.now in range(horizon + 3):
        found = interpolated(values, horizon, count, spline, phase=grid.now * count % horizon)
        np.testing.assert_allclose(found, grid.actions(values), atol=1e-5, err_msg=f"step {grid.now}")


def test_interpolated_actions_stay_within_the_bounds() -> None:
    values = np.array([0.0, 1.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])[:, None, None]
    free, bounded = (interpolated(values, 12, 4, "cubic", limit=limit) for limit in (np.inf, 1.0))
    assert free.max() > 1.05
    np.testing.assert_allclose(bounded, np.minimum(free, 1.0))


def test_worlds_of_the_same_sample_are_consecutive_and_get_the_same_actions() -> None:
    values = np.arange(10.0).reshape(5, 2, 1)
    found = interpolated(values, 4, 4, "zero", models=3)
    np.testing.assert_array_equal(found[..., 0], np.repeat(values[:4, :, 0], 3, axis=1))


@pytest.mark.parametrize("horizon, count", [(12, 4), (13, 4), (7, 5), (5, 5), (9, 1)])
def test_number_of_passed_knots_is_proportional_to_the_steps(horizon: int, count: int) -> None:
    phase, passed, steps = (wp.zeros(1, dtype=int, device="cpu") for _ in range(3))
    time = total = 0
    for shift in (0, 1, 1, 3, horizon, 2 * horizon + 1, 1):
        steps.fill_(shift)
        wp.launch(knots.pass_knots, 1, [steps, horizon, count, phase, passed], device="cpu")
        time, total = time + shift, total + int(passed.numpy()[0])
        assert total == time * count // horizon and phase.numpy()[0] == time * count % horizon
