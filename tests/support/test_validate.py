from typing import Any

import numpy as np
import pytest
import torch

from lyceum_warp.support.validate import check_kind, check_tensor, finite_number, layer_sizes, whole_number


@pytest.mark.parametrize("value", [3, 3.0, np.int64(3), np.float32(3), torch.tensor(3)])
def test_whole_number_of_any_type_is_converted_to_int(value: Any) -> None:
    number = whole_number("horizon", value, low=0)
    assert (number, type(number)) == (3, int)


@pytest.mark.parametrize("value", [-1, 2.5, "a", None, float("nan"), float("inf"), 2**31, [1, 2]])
def test_error_of_an_invalid_whole_number_names_the_bounds(value: Any) -> None:
    with pytest.raises(ValueError) as caught:
        whole_number("horizon", value, low=0)
    assert str(caught.value) == f"horizon must be a whole number from 0 to 2147483647, not {value!r}"


def test_finite_number_within_its_bounds_is_converted_to_float() -> None:
    for value in (1, 1.0, np.float32(1)):
        assert type(finite_number("gamma", value, low=0, high=1)) is float
    for wrong, bounds in (
        (2, {"low": 0, "high": 1}),
        (-1, {"low": 0}),
        (float("nan"), {}),
        (10**400, {}),
        ("a", {}),
        (True, {}),
    ):
        with pytest.raises(ValueError, match="gamma must be a finite number"):
            finite_number("gamma", wrong, **bounds)


def test_object_of_a_wrong_type_raises_an_error_with_an_example() -> None:
    check_kind("policy", torch.nn.Identity(), torch.nn.Module, "as lw.Policy(...)")
    with pytest.raises(ValueError, match=r"policy must be of type Module, as lw\.Policy\(\.\.\.\), not int 3"):
        check_kind("policy", 3, torch.nn.Module, "as lw.Policy(...)")


def test_layer_sizes_must_be_a_sequence_of_positive_whole_numbers() -> None:
    assert layer_sizes((64, 32.0)) == [64, 32]
    for wrong in (64, (64, 0), "ab"):
        with pytest.raises(ValueError, match=r"hidden .*widths.*, as in \(64, 64\)"):
            layer_sizes(wrong)


def test_tensor_must_have_the_shape_and_type_of_the_buffer() -> None:
    buffer = torch.zeros(2, 3)
    check_tensor(torch.ones(2, 3), "action", buffer)
    wrong = {
        "a float32 tensor of shape \\(3,\\)": torch.ones(3),
        "a float64 tensor of shape \\(2, 3\\)": torch.ones(2, 3, dtype=torch.float64),
        "a ndarray of shape \\(2, 3\\)": np.ones((2, 3)),
        "list \\[1\\]": [1],
    }
    for text, value in wrong.items():
        with pytest.raises(ValueError, match=rf"action must be a float32 tensor of shape \(2, 3\), not {text}"):
            check_tensor(value, "action", buffer)
    with pytest.raises(ValueError, match=r"action must be on cpu, not on meta: move it with \.to\(\)"):
        check_tensor(torch.ones(2, 3, device="meta"), "action", buffer)
