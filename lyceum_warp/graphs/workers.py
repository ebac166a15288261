"""Threads that replay graphs of launches side by side."""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait


class Workers:
    """Threads that start with the first calls that need them, and end once this object is garbage-collected.

    Args:
        nthread: The most threads that work, the caller's among them.
    """

    def __init__(self, nthread: int) -> None:
        self.nthread = nthread
        self._pool = ThreadPoolExecutor(max(nthread - 1, 1), "lyceum_warp")

    def run(self, calls: Sequence[Callable[[], object]]) -> None:
        """Call functions that release Python's lock while they work, and wait until all have returned.

        Args:
            calls: The functions, one for each thread at most; the caller's takes the first one.

        Raises:
            BaseException: That of a function, once all of them have ended.
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
    """Wait until all have ended, after an interrupt, too: they work on arrays that the caller reads next."""
    interrupt: KeyboardInterrupt | None = None
    while not all(future.done() for future in futures):
        try:
            wait(futures)
        except KeyboardInterrupt as raised:
            interrupt = raised
    if interrupt is not None:
        raise interrupt
