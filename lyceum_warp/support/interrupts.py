"""Turn Ctrl-C, SIGTERM and SIGHUP into an exception, at once or when the caller is ready."""

import contextlib
import signal
from collections.abc import Callable, Iterator
from typing import Any

_NUMBERS: list[int] = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


class Interrupted(BaseException):
    """Raised when a signal asks the program to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def _ignore(number: int, frame: Any) -> None:
    """Ignore a signal. ``obeyed`` replaces only this handler."""


def _interrupt(number: int, frame: Any) -> None:
    for other in _NUMBERS:
        if signal.getsignal(other) is _interrupt:
            signal.signal(other, _ignore)
    raise Interrupted(number)


@contextlib.contextmanager
def signals(handler: Callable[[int, Any], None] = _interrupt, *, replaces: Any = None) -> Iterator[dict[int, Any]]:
    """Raise Interrupted at the first Ctrl-C, SIGTERM or SIGHUP within the context.

    Later signals raise it only within ``obeyed``.

    Args:
        handler: The handler of the signals; by default it raises Interrupted.
        replaces: If given, only this handler is replaced. By default, all handlers are replaced except those that
            ignore a signal.

    Yields:
        The replaced handlers, as a dict with signal numbers as keys. They are restored at the end of the context.
    """
    previous: dict[int, Any] = {}
    with contextlib.suppress(ValueError):  # only the main thread may set signal handlers
        for number in _NUMBERS:
            current = signal.getsignal(number)
            if current is replaces or (replaces is None and current not in (signal.SIG_IGN, _ignore)):
                previous[number] = signal.signal(number, handler)
    try:
        yield previous
    finally:
        for number, other in previous.items():
            signal.signal(number, other)


def obeyed() -> contextlib.AbstractContextManager[object]:
    """Raise Interrupted at the next Ctrl-C, SIGTERM or SIGHUP, even if an earlier signal has already raised it."""
    return signals(replaces=_ignore)


def _raise(number: int) -> None:
    """Send a signal to this process.

    The default handlers of SIGTERM and SIGHUP would end the program without its ``finally`` blocks.
    """
    if signal.getsignal(number) is signal.SIG_DFL:
        raise SystemExit(128 + number)
    signal.raise_signal(signal.Signals(number))


@contextlib.contextmanager
def postponed(*, insist: bool = False) -> Iterator[list[int]]:
    """Collect Ctrl-C, SIGTERM and SIGHUP in a list until the context ends, and then handle the first one.

    Once Interrupted is raised, further signals are ignored.

    Args:
        insist: Whether a second signal is handled at once.
    """
    noted: list[int] = []

    def note(number: int, frame: Any) -> None:
        if noted and insist:
            noted.clear()
            signal.signal(number, previous[number])
            _raise(number)
        else:
            noted.append(number)

    with signals(note) as previous:
        try:
            yield noted
        except Interrupted:
            previous.update(dict.fromkeys(previous, _ignore))
            raise
    if noted:
        _raise(noted[0])
