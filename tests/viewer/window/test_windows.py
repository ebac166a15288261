import numpy as np
import pytest

from lyceum_warp.viewer.window.actions import SPEEDS
from lyceum_warp.viewer.window.windows import Curves, numbers, speed_name


def ramp(begin: int, end: int) -> np.ndarray:
    times = np.arange(begin, end, dtype=float)
    return np.stack([times, 2 * times], axis=1)


def test_curves_keep_the_newest_points_in_order() -> None:
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
    curves.add(np.concatenate([ramp(7, 10), ramp(0, 2)]))  # a new episode
    np.testing.assert_array_equal(curves.rows, ramp(0, 2))


def test_thinned_curve_keeps_its_extremes() -> None:
    curves = Curves(1)
    rows = ramp(0, 1000)
    rows[:, 1] = 0
    rows[333, 1], rows[777, 1] = 5, -7
    curves.add(rows[:50])
    np.testing.assert_array_equal(curves.thinned(50), rows[:50])
    curves.add(rows[50:])
    thin = curves.thinned(50)
    assert len(thin) == 50
    assert (thin[:, 1].min(), thin[:, 1].max()) == (-7, 5)
    assert (np.diff(thin[:, 0]) >= 0).all()


def test_speeds_are_named_as_fractions() -> None:
    assert [speed_name(speed) for speed in SPEEDS] == ["1/16", "1/8", "1/4", "1/2", "1", "2", "4", "8", "16"]


def test_numbers_and_ranges_are_read_once_each() -> None:
    assert numbers("1 2, 5-7 6", 8, 5) == (1, 2, 5, 6, 7)
    assert numbers("", 8, 5) == ()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 x", "'x' is not"), ("1-", "'1-' is not"), ("7-9", "no world 8"), ("-1", "'-1'"), ("9", "no world 9"),
        ("1 20-30", "no world 20"), ("5-2", "write 2-5"), ("0-5", "too many worlds in '0-5': 5 can"),
        ("0-3 6 7", "too many"), ("0-99999999999", "no world 8"),
    ],
)  # fmt: skip
def test_numbers_of_another_form_are_refused(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        numbers(text, 8, 5)
