import numpy as np

from lyceum_warp.viewer.window.windows import Curves


def ramp(begin: int, end: int) -> np.ndarray:
    times = np.arange(begin, end, dtype=float)
    return np.stack([times, 0 * times, 2 * times], axis=1)


def test_curves_keep_the_newest_points_in_order() -> None:
    curves = Curves(1)
    for i in range(0, 30_000, 1000):
        curves.add(ramp(i, i + 1000))
    np.testing.assert_array_equal(curves.rows, ramp(10_000, 30_000))


def test_curve_drops_later_points_when_time_decreases() -> None:
    curves = Curves(1)
    curves.add(ramp(0, 10))
    curves.add(ramp(6, 7))
    np.testing.assert_array_equal(curves.rows, ramp(0, 7))
    curves.add(np.concatenate([ramp(7, 10), ramp(0, 2)]))  # a new episode
    np.testing.assert_array_equal(curves.rows, ramp(0, 2))
