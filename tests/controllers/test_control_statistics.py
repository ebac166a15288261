"""Statistics of a controller's episodes; ``test_control_report.py`` tests those that a report holds."""

import numpy as np
import pytest

from lyceum_warp.controllers.control_statistics import differing_names, std, wilson


def test_wilson_interval_matches_published_values() -> None:
    assert wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson(0, 10) == pytest.approx((0, 0.2775), abs=1e-4)
    assert wilson(10, 10) == pytest.approx((0.7225, 1), abs=1e-4)


def test_std_of_one_value_or_of_infinite_values_is_none() -> None:
    assert std(np.array([1.0])) is None and std(np.array([1.0, np.inf])) is None
    assert std(np.array([1.0, 3.0])) == pytest.approx(2**0.5)


def test_differing_names_are_listed_once() -> None:
    assert differing_names([{"a": 1, "b": 2}, {"a": 1, "b": 3}, {"a": 1, "c": 0}]) == ["b", "c"]
