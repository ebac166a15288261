"""Threads that replay graphs of launches side by side."""

import queue
import threading
import weakref
from collections.abc import Callable, Sequence

_Inbox = queue.SimpleQueue[tuple[Callable[[], object], "_Outbox"] | None]
_Outbox = queue.SimpleQueue[BaseException | None]


class Workers:
    """Threads of one owner; they end when it is collected. They start where calls need them, on the caller's cores.

    Args:
        nthread: The most threads that work, the caller's among them.
    """

    def __init__(self, nthread: int) -> None:
        self.nthread = nthread
        self._inbox: _Inbox = queue.SimpleQueue()
        self._threads: list[threading.Thread] = []
        weakref.finalize(self, _stop, self._inbox, self._threads)

    def run(self, calls: Sequence[Callable[[], object]]) -> None:
        """Call functions that release Python's lock while they work, and wait until all have returned.

        Args:
            calls: The functions, one for each thread at most; the caller's takes the first one.

        Raises:
            BaseException: That of a function, once all of them have ended.
        """
        while len(self._threads) < min(len(calls), self.nthread) - 1:
            thread = threading.Thread(target=_work, args=(self._inbox,), name="lyceum_warp", daemon=True)
            thread.start()
            self._threads.append(thread)
        outbox: _Outbox = queue.SimpleQueue()
        for call in calls[1:]:
            self._inbox.put((call, outbox))
        failed: BaseException | None = None
        try:
            calls[0]()
        finally:  # the others work on the same arrays, and must not outlast this call
            for _ in calls[1:]:
                failed = outbox.get() or failed
        if failed is not None:
            raise failed


def _work(inbox: _Inbox) -> None:
    while (given := inbox.get()) is not None:
        call, outbox = given
        error: BaseException | None = None
        try:
            call()
        except BaseException as raised:
            error = raised
        outbox.put(error)
        del given, call, outbox, error  # a waiting thread must keep nothing alive


def _stop(inbox: _Inbox, threads: list[threading.Thread]) -> None:
    for _ in threads:
        inbox.put(None)
