import numpy as np

from lyceum_warp.viewer.window.windows import Curves


def ramp(begin: int, end: int) -> np.ndarray:
    times = np.arange(begin, end, dtype=float)
    return np.stack([times, 2 * times], axis=1)


def test_points_are_kept_in_order() -> None:
    curves = Curves(1)
    curves.add(ramp(0, 3))
    curves.add(ramp(3, 5))
    np.testing.assert_array_equal(curves.rows, ramp(0, 5))


def test_newest_points_are_kept_beyond_the_capacity() -> None:
    curves = Curves(1, capacity=10)
    for i in range(100):
        curves.add(ramp(i, i + 1))
    np.testing.assert_array_equal(curves.rows, ramp(90, 100))
    curves.add(ramp(100, 200))
    np.testing.assert_array_equal(curves.rows, ramp(190, 200))


def test_time_that_goes_back_drops_the_points_from_there_on() -> None:
    curves = Curves(1)
    curves.add(ramp(0, 10))
    curves.add(ramp(6, 7))
    np.testing.assert_array_equal(curves.rows, ramp(0, 7))


def test_new_episode_begins_new_curves() -> None:
    curves = Curves(1)
    curves.add(np.concatenate([ramp(0, 10), ramp(0, 2)]))
    np.testing.assert_array_equal(curves.rows, ramp(0, 2))


def test_thinned_curve_keeps_its_extremes() -> None:
    curves = Curves(1)
    rows = ramp(0, 1000)
    rows[:, 1] = 0
    rows[333, 1], rows[777, 1] = 5, -7
    curves.add(rows)
    thin = curves.thinned(50)
    assert len(thin) == 50
    assert (thin[:, 1].min(), thin[:, 1].max()) == (-7, 5)
    assert (np.diff(thin[:, 0]) >= 0).all()


def test_short_curve_is_not_thinned() -> None:
    curves = Curves(1)
    curves.add(ramp(0, 20))
    np.testing.assert_array_equal(curves.thinned(50), ramp(0, 20))
