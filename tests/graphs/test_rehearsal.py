import threading

import pytest
import warp as wp

from lyceum_warp.graphs.compilation import rehearse
from lyceum_warp.kernels.state import fill_rows64

REPLACED = {
    wp: ("launch", "launch_tiled", "capture_while", "capture_if"),
    wp.utils: ("radix_sort_pairs", "segmented_sort_pairs", "array_scan"),
}


def launch(mask: wp.array, row: wp.array, rows: wp.array) -> None:
    wp.launch(fill_rows64, (3, 1), [mask, row, rows, 1, 0], device="cpu")


@pytest.fixture
def arrays() -> tuple[wp.array, wp.array, wp.array]:
    mask = wp.full(3, True, dtype=bool, device="cpu")
    return mask, wp.full(2, 1, dtype=wp.float64, device="cpu"), wp.zeros((3, 2), dtype=wp.float64, device="cpu")


def test_a_rehearsal_lists_launches_without_running_them(arrays: tuple[wp.array, wp.array, wp.array]) -> None:
    flag = wp.zeros(1, dtype=int, device="cpu")
    with rehearse() as rehearsal:
        launch(*arrays)
        wp.capture_if(flag, on_true=lambda: launch(*arrays))
        wp.capture_while(flag, while_body=lambda: launch(*arrays))
    assert list(rehearsal) == [(fill_rows64.module, None)]
    assert not arrays[2].numpy().any()
    launch(*arrays)
    assert arrays[2].numpy().all()


def originals() -> list[object]:
    return [getattr(owner, name) for owner, names in REPLACED.items() for name in names]


def test_rehearsal_restores_warp_after_success_and_after_an_error(arrays: tuple[wp.array, wp.array, wp.array]) -> None:
    before = originals()
    with pytest.raises(ZeroDivisionError), rehearse():
        assert not set(originals()) & set(before)
        raise ZeroDivisionError
    assert originals() == before


def test_rehearsals_in_two_threads_run_one_after_the_other(arrays: tuple[wp.array, wp.array, wp.array]) -> None:
    before, order = originals(), []
    inside, release = threading.Event(), threading.Event()

    def first() -> None:
        with rehearse() as rehearsal:
            inside.set()
            release.wait(10)
            launch(*arrays)
            order.append(("first", len(rehearsal)))

    def second() -> None:
        with rehearse() as rehearsal:
            launch(*arrays)
            order.append(("second", len(rehearsal)))

    threads = [threading.Thread(target=first), threading.Thread(target=second)]
    threads[0].start()
    assert inside.wait(10)
    threads[1].start()
    threads[1].join(0.2)
    assert threads[1].is_alive() and not order
    launch(*arrays)
    assert arrays[2].numpy().all()
    release.set()
    for thread in threads:
        thread.join(10)
    assert order == [("first", 1), ("second", 1)]
    assert originals() == before
