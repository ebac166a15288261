"""Replay graphs of launches in parallel threads."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait


class Workers:
    """Pool of threads that start on demand and end when the pool is garbage-collected."""

    def __init__(self, nthread: int) -> None:
        self.nthread = nthread
        self._pool = ThreadPoolExecutor(max(nthread - 1, 1), "lyceum_warp")

    def run(self, calls: Sequence[Callable[[], object]]) -> None:
        """Call functions in parallel threads, and wait until all functions have returned.

        The functions run at the same time only while they release Python's GIL.

        Raises:
            BaseException: Any exception that a function raised; all other functions have ended.
        """
        others: list[Future[object]] = []
        try:
            for call in calls[1:]:
                others.append(self._pool.submit(call))
            calls[0]()
        finally:
            _wait(others)
        for other in others:
            other.result()


def _wait(futures: Sequence[Future[object]]) -> None:
    """Wait for all futures, even after an interrupt, because the functions write arrays that the caller reads next."""
    interrupt: KeyboardInterrupt | None = None
    while not all(future.done() for future in futures):
        try:
            wait(futures)
        except KeyboardInterrupt as raised:
            interrupt = raised
    if interrupt is not None:
        raise interrupt
