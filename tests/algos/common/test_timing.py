"""Run two functions in parallel, with one torch thread each."""

import threading
from collections.abc import Iterator

import pytest
import torch

from lyceum_warp.algos.common.timing import beside


@pytest.fixture(autouse=True)
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def test_an_error_in_one_call_is_raised_after_the_other_ends() -> None:
    torch.set_num_threads(2)
    go, done = threading.Event(), threading.Event()

    def slow() -> None:
        go.wait(10.0)
        done.set()

    with pytest.raises(KeyboardInterrupt), beside(slow, allowed=True):
        go.set()
        raise KeyboardInterrupt
    assert done.is_set()

    def fails() -> None:
        raise KeyError("fit")

    with pytest.raises(KeyError, match="fit"), beside(fails, allowed=True) as result:
        result()
    assert torch.get_num_threads() == 2
