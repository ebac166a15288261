"""Turn Ctrl-C, SIGTERM and SIGHUP into an exception, raised immediately or when the caller can handle it."""

import contextlib
import signal
from collections.abc import Callable, Iterator
from typing import Any

_NUMBERS = [int(getattr(signal, name)) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""The numbers of SIGINT, SIGTERM and, except on Windows, SIGHUP."""


class Interrupted(BaseException):
    """Raised when a signal requests the end of the program."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def _ignore(number: int, frame: Any) -> None:
    """Ignore a signal after Interrupted was raised. Unlike SIG_IGN, this handler is replaced by ``obeyed``."""


def _interrupt(number: int, frame: Any) -> None:
    """Raise Interrupted, and ignore all later signals."""
    for other in _NUMBERS:
        if signal.getsignal(other) is _interrupt:
            signal.signal(other, _ignore)
    raise Interrupted(number)


def _leave(number: int, frame: Any) -> None:
    raise SystemExit(128 + number)


@contextlib.contextmanager
def _handling(handler: Callable[[int, Any], None], replaces: Callable[[Any], bool]) -> Iterator[dict[int, Any]]:
    """Within the context, ``handler`` replaces other handlers.

    Args:
        handler: The handler.
        replaces: Called with a current handler; returns whether to replace it.

    Yields:
        The replaced handlers by signal, to be restored at the end.
    """
    previous: dict[int, Any] = {}
    with contextlib.suppress(ValueError):  # only the main thread may set handlers
        for number in _NUMBERS:
            if replaces(signal.getsignal(number)):
                previous[number] = signal.signal(number, handler)
    try:
        yield previous
    finally:
        for number, other in previous.items():
            signal.signal(number, other)


def _is_active(handler: Any) -> bool:
    """Whether a signal with this handler reaches the program.

    Shells make background programs ignore SIGINT, and nohup makes programs ignore SIGHUP.
    """
    return handler not in (signal.SIG_IGN, _ignore)


@contextlib.contextmanager
def signals() -> Iterator[None]:
    """Within the context, the first Ctrl-C, SIGTERM or SIGHUP raises Interrupted.

    Later signals do so only within ``obeyed``.
    """
    with _handling(_interrupt, _is_active):
        yield


@contextlib.contextmanager
def ending() -> Iterator[None]:
    """Within the context SIGTERM and SIGHUP raise SystemExit, unless the program handles them.

    By default these signals end a program immediately, without running its ``finally`` blocks.
    """
    with _handling(_leave, lambda handler: handler is signal.SIG_DFL):
        yield


@contextlib.contextmanager
def obeyed() -> Iterator[None]:
    """Within the context, a second Ctrl-C, SIGTERM or SIGHUP (after the first in ``signals``) raises Interrupted, too.

    This allows the user to cancel long work at the end of a program.
    """
    with _handling(_interrupt, lambda handler: handler is _ignore):
        yield


@contextlib.contextmanager
def postponed(*, insist: bool = False) -> Iterator[list[int]]:
    """Within the context, collect Ctrl-C, SIGTERM and SIGHUP in the yielded list; the first is handled at the end.

    Once Interrupted is raised, later signals are ignored.

    Args:
        insist: Whether a second signal is handled immediately.

    Raises:
        Interrupted: A signal was postponed, and ``signals`` is active.
    """
    noted: list[int] = []

    def note(number: int, frame: Any) -> None:
        if noted and insist:
            noted.clear()
            signal.signal(number, previous[number])
            signal.raise_signal(signal.Signals(number))
        else:
            noted.append(number)

    with _handling(note, _is_active) as previous:
        try:
            yield noted
        except Interrupted:
            previous.update(dict.fromkeys(previous, _ignore))
            raise
    if noted:
        signal.raise_signal(signal.Signals(noted[0]))
