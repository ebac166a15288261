import gc
import signal
import threading
import time
from collections.abc import Callable

import pytest

from lyceum_warp.graphs.workers import Workers


def own_threads() -> set[threading.Thread]:
    return {thread for thread in threading.enumerate() if thread.name.startswith("lyceum_warp_")}


def test_threads_start_on_demand_and_end_with_the_last_reference_to_their_pool() -> None:
    before = own_threads()
    workers = Workers(3)
    assert not own_threads() - before
    for calls in (1, 2, 3, 2):
        workers.run([threading.Barrier(calls).wait] * calls)
    assert len(own_threads() - before) == 2
    del workers
    gc.collect()
    end = time.monotonic() + 10
    while own_threads() - before and time.monotonic() < end:
        time.sleep(0.01)
    assert not own_threads() - before


def test_interrupt_waits_for_running_calls() -> None:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # background processes of a shell ignore SIGINT
    ended: list[bool] = []
    begun = threading.Event()

    def late() -> None:
        begun.wait()
        time.sleep(0.05)
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)  # type: ignore[arg-type]
        time.sleep(0.2)
        ended.append(True)

    try:
        with pytest.raises(KeyboardInterrupt):
            Workers(2).run([begun.set, late])
    finally:
        signal.signal(signal.SIGINT, before)
    assert ended


@pytest.mark.parametrize("place", [0, 1])
def test_an_error_is_raised_after_all_calls_have_ended(place: int) -> None:
    ended = []

    def late() -> None:
        time.sleep(0.05)
        ended.append(True)

    def wrong() -> None:
        raise ZeroDivisionError

    calls: list[Callable[[], object]] = [late, late]
    calls.insert(place, wrong)
    workers = Workers(3)
    with pytest.raises(ZeroDivisionError):
        workers.run(calls)
    assert ended == [True, True]
    workers.run([late] * 3)
    assert len(ended) == 5
