from typing import Any

import numpy as np
import pytest
import torch

from lyceum_warp.support.tensors import check_tensor
from lyceum_warp.support.validate import whole_number


@pytest.mark.parametrize("value", [3, 3.0, np.int64(3), np.float32(3), torch.tensor(3)])
def test_whole_number_of_any_type_is_converted_to_int(value: Any) -> None:
    number = whole_number("horizon", value, low=0)
    assert (number, type(number)) == (3, int)


@pytest.mark.parametrize("value", [-1, 2.5, "a", None, float("nan"), float("inf"), 2**31, [1, 2]])
def test_error_of_an_invalid_whole_number_names_the_bounds(value: Any) -> None:
    with pytest.raises(ValueError) as caught:
        whole_number("horizon", value, low=0)
    assert str(caught.value) == f"horizon must be a whole number from 0 to 2147483647, not {value!r}"


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
