import gc
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import pytest
import warp as wp

from lyceum_warp.graphs import capture
from lyceum_warp.graphs.capture import Graphs, Phase
from lyceum_warp.graphs.workers import Workers
from lyceum_warp.support.arrays import launch_worlds


@wp.kernel(enable_backward=False)
def append(digit: int, number_inout: wp.array[int]):
    number_inout[0] = 10 * number_inout[0] + digit


class Digits:
    def __init__(self) -> None:
        self.number = wp.zeros(1, dtype=int, device="cpu")
        self.calls = 0

    def phase(self, digit: int, *, engine: bool = False) -> Phase:
        def run() -> None:
            self.calls += 1
            wp.launch(append, 1, [digit, self.number], device="cpu")

        return Phase(str(digit), run, engine=engine)

    def after(self, calls: tuple) -> int:
        self.number.zero_()
        for call in calls:
            call()
        return int(self.number.numpy()[0])


def graphs(**options: bool) -> Graphs:
    return Graphs(wp.get_device("cpu"), **options)


def test_consecutive_phases_become_one_graph_in_the_second_call() -> None:
    digits = Digits()
    calls = graphs().sequence([digits.phase(1), digits.phase(2, engine=True), digits.phase(3)])
    assert len(calls) == 1
    assert [digits.after(calls) for _ in range(4)] == [123] * 4
    assert digits.calls == 6  # the first call launches kernels, and the second call captures graphs


@wp.kernel(enable_backward=False)
def follow(digit: int, number_inout: wp.array[int], first: int):
    w = first + wp.tid()
    number_inout[w] = 10 * number_inout[w] + digit


def test_threads_divide_the_worlds_in_phases_that_allow_it(monkeypatch: pytest.MonkeyPatch) -> None:
    digits, sizes = wp.zeros(5, dtype=int, device="cpu"), []
    launch = wp.launch

    def phase(digit: int, *, by_world: bool) -> Phase:
        run = partial(launch_worlds, follow, 5, [digit, digits], wp.get_device("cpu"))
        return Phase(str(digit), run, by_world=by_world)

    def noted(kernel: wp.Kernel, dim: tuple[int, ...], *args: Any, **options: Any) -> None:
        sizes.append(dim[0])
        launch(kernel, dim, *args, **options)

    monkeypatch.setattr(wp, "launch", noted)
    monkeypatch.setattr(capture, "SECONDS_A_THREAD", 1e-9)
    made = Graphs(wp.get_device("cpu"), workers=Workers(2))
    shared = [True, True, False, True]
    calls = made.sequence([phase(i + 1, by_world=by_world) for i, by_world in enumerate(shared)])
    assert len(calls) == 3
    for _ in range(capture.TIMED + 3):
        digits.zero_()
        for call in calls:
            call()
        assert digits.numpy().tolist() == [1234] * 5
    assert sizes == [5, 5, 5, 5, 5, 5, 5, 5, *(2, 2, 3, 3), *(2, 3)]


@wp.kernel(enable_backward=False, module="lyceum_warp.tests.tiles")
def add_tiles(number: int, sum_out: wp.array[int]):
    i, _ = wp.tid()
    total = int(0)  # noqa: RUF046
    for _ in range(100):
        total = total + wp.tile_extract(wp.tile_sum(wp.tile_ones(dtype=int, shape=64)), 0)
    sum_out[i] = number * total


def test_kernels_with_tiles_have_separate_tiles_in_every_thread() -> None:
    def wrong(number: int) -> int:
        sums, count = wp.zeros(20, dtype=int, device="cpu"), 0
        launch = partial(wp.launch_tiled, add_tiles, dim=[20], inputs=[number, sums], block_dim=64, device="cpu")
        (call,) = graphs(enabled=number < 3).sequence([Phase("add", launch)])
        for _ in range(300):
            sums.zero_()
            call()
            count += int((sums.numpy() != 6400 * number).sum())
        return count

    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(wrong, range(1, 5))) == 0


def test_changed_launches_are_captured_again_after_calling_forget() -> None:
    digits, made = Digits(), graphs()
    digit = [1]
    calls = made.sequence([Phase("digit", lambda: wp.launch(append, 1, [digit[0], digits.number], device="cpu"))])
    assert [digits.after(calls) for _ in range(3)] == [1] * 3
    digit[0] = 2
    assert digits.after(calls) == 1  # the graph keeps the argument alive
    made.forget()
    assert [digits.after(calls) for _ in range(3)] == [2] * 3


def test_unused_objects_are_deleted_after_a_capture() -> None:
    """A capture fails if a torch graph is deleted at the same time."""
    digits, captures, deleted = Digits(), 0, []

    class Unused:
        def __init__(self) -> None:
            self.itself = self  # only the garbage collector can delete this cycle

        def __del__(self) -> None:
            deleted.append(captures)

    def run() -> None:
        nonlocal captures
        captures += 1
        [[] for _ in range(10_000)]  # create enough new objects to trigger a collection
        captures += 1

    calls = Graphs(wp.get_device("cpu"), enabled=True).sequence([digits.phase(1), Phase("run", run)])
    digits.after(calls)
    gc.collect()
    Unused()
    digits.after(calls)
    gc.collect()
    assert captures == 4 and deleted == [4] and gc.isenabled()
