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


def test_thinned_curve_keeps_its_extremes_and_the_ends_of_episodes() -> None:
    curves = Curves(1)
    rows = ramp(0, 1000)
    rows[:, 2] = 0
    rows[333, 2], rows[777, 2], rows[500, 1] = 5, -7, 1
    curves.add(rows[:50])
    np.testing.assert_array_equal(curves.thinned(50, 1e3), 3 * [rows[:50]])
    curves.add(rows[50:])
    low, mean, high = curves.thinned(50, 1e3)
    assert len(mean) == 50 and (low[:, 2].min(), high[:, 2].max()) == (-7, 5)
    assert (low <= mean).all() and (mean <= high).all() and high[:, 1].sum() == 1
    assert curves.thinned(50, 10.0)[0][0, 0] == 989
