"""Replay graphs of launches in parallel threads."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait


class Workers:
    """A pool of threads that start on demand and end once this object is garbage-collected.

    Args:
        nthread: The largest number of threads, including the caller's.
    """

    def __init__(self, nthread: int) -> None:
        self.nthread = nthread
        self._pool = ThreadPoolExecutor(max(nthread - 1, 1), "lyceum_warp")

    def run(self, calls: Sequence[Callable[[], object]]) -> None:
        """Call functions that release Python's GIL, in parallel, and wait until all have returned.

        Args:
            calls: The functions, at most ``nthread``; the caller's thread runs the first one.

        Raises:
            BaseException: Any exception that a function raised; the other functions have ended.
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
    """Wait for all futures, even after an interrupt, because they write arrays that the caller reads next."""
    interrupt: KeyboardInterrupt | None = None
    while not all(future.done() for future in futures):
        try:
            wait(futures)
        except KeyboardInterrupt as raised:
            interrupt = raised
    if interrupt is not None:
        raise interrupt
