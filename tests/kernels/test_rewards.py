import numpy as np
import pytest
import warp as wp

import lyceum_warp as lw

SIGMOIDS = {sigmoid.name.lower(): sigmoid for sigmoid in lw.Sigmoid}
INF = np.inf


@wp.kernel
def tolerances(x: wp.array[float], bounds: wp.vec2, margin: float, sigmoid: int, v: float, out: wp.array[float]):
    i = wp.tid()
    out[i] = lw.tolerance(x[i], bounds, margin, sigmoid, v)


def tolerance(x: np.ndarray, bounds: tuple[float, float], margin: float, sigmoid: int, v: float) -> np.ndarray:
    out = wp.zeros(len(x), dtype=float, device="cpu")
    args = [wp.array(x, dtype=float, device="cpu"), wp.vec2(*bounds), margin, int(sigmoid), v, out]
    wp.launch(tolerances, len(x), args, device="cpu")
    found: np.ndarray = out.numpy()
    return found


@pytest.mark.parametrize("name", SIGMOIDS)
def test_tolerance_equals_that_of_dm_control(name: str) -> None:
    rewards = pytest.importorskip("dm_control.utils.rewards", reason="dm_control is the oracle of tolerance")
    x = np.linspace(-5.0, 5.0, 201, dtype=np.float32)
    values = (0.05, 0.1, 0.7) + ((0.0,) if name in ("cosine", "linear", "quadratic") else ())
    for bounds in ((0.0, 0.0), (-1.0, 0.5), (1.0, INF), (-INF, -2.0)):
        for margin in (0.3, 2.0):
            for v in values:
                wanted = rewards.tolerance(x, bounds, margin, name, v)
                np.testing.assert_allclose(tolerance(x, bounds, margin, SIGMOIDS[name], v), wanted, atol=2e-6)
    wanted = rewards.tolerance(x, (-1.0, 0.5), 0.0)
    np.testing.assert_array_equal(tolerance(x, (-1.0, 0.5), 0.0, SIGMOIDS[name], 0.1), wanted)


@wp.kernel
def bound(x: wp.array[float], limits: wp.vec2, one: wp.array[bool], every: wp.array[bool]):
    i = wp.tid()
    one[i] = lw.inside(x[i], limits)
    every[i] = lw.all_inside(x, i, x.shape[0], limits)


def test_number_at_a_bound_and_nan_are_not_inside_the_bounds() -> None:
    x = np.array([np.nan, -1.0, INF, -INF, 2.0, 1.999, 0.0], dtype=np.float32)
    one, every = (wp.zeros(len(x), dtype=bool, device="cpu") for _ in range(2))
    wp.launch(bound, len(x), [wp.array(x, dtype=float, device="cpu"), wp.vec2(-1.0, 2.0), one, every], device="cpu")
    assert one.numpy().tolist() == [False] * 5 + [True] * 2
    assert every.numpy().tolist() == [False] * 5 + [True] * 2


@wp.kernel
def grasps(distance: wp.array[float], finger: wp.array[float], out: wp.array2d[float]):
    i = wp.tid()
    near, reach, grasp = lw.grasp_terms(distance[i], finger[i], 0.01)
    out[i, 0] = near
    out[i, 1] = reach
    out[i, 2] = grasp


def test_grasp_terms_match_the_documented_values() -> None:
    cases = {  # (distance, finger opening): expected (near, reach, grasp)
        (0.0, 0.005): (1.0, 1.0, 1.0),
        (0.0, 0.04): (1.0, 1.0, 0.0),
        (0.02, 0.04): (0.1, 1.0 / 1.6, 0.45),
        (0.105, 0.04): (0.0, 0.2, 0.5),
        (0.105, 0.005): (0.0, 0.2, 0.0),
        (0.105, 0.03): (0.0, 0.2, 0.45),
    }
    distance, finger = (wp.array(x, dtype=float, device="cpu") for x in zip(*cases, strict=True))
    out = wp.zeros((len(cases), 3), dtype=float, device="cpu")
    wp.launch(grasps, len(cases), [distance, finger, out], device="cpu")
    np.testing.assert_allclose(out.numpy(), list(cases.values()), atol=1e-6)
