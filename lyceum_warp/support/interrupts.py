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
    """Ignore a signal. ``obeyed`` replaces this handler, but not SIG_IGN."""


def _interrupt(number: int, frame: Any) -> None:
    """Raise Interrupted, and ignore all later signals."""
    for other in _NUMBERS:
        if signal.getsignal(other) is _interrupt:
            signal.signal(other, _ignore)
    raise Interrupted(number)


@contextlib.contextmanager
def signals(handler: Callable[[int, Any], None] = _interrupt, *, replaces: Any = None) -> Iterator[dict[int, Any]]:
    """Within the context, the first Ctrl-C, SIGTERM or SIGHUP raises Interrupted.

    Later signals raise Interrupted only within ``obeyed``.

    Args:
        handler: The handler of the signals; by default it raises Interrupted.
        replaces: Replace only this handler; by default, replace every handler that does not ignore the signal. Shells
            make background programs ignore SIGINT, and nohup makes programs ignore SIGHUP.

    Yields:
        Replaced handlers, by signal; the context restores them at its end.
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
    """After the first Ctrl-C, SIGTERM or SIGHUP (see ``signals``), let the next signal raise Interrupted, too.

    The user can then cancel long work at the end of a program.
    """
    return signals(replaces=_ignore)


def _raise(number: int) -> None:
    """Send a signal to this process, so that the signal's current handler runs.

    The default handlers of SIGTERM and SIGHUP would end the program without running its ``finally`` blocks.

    Raises:
        SystemExit: The signal has its default handler.
    """
    if signal.getsignal(number) is signal.SIG_DFL:
        raise SystemExit(128 + number)
    signal.raise_signal(signal.Signals(number))


@contextlib.contextmanager
def postponed(*, insist: bool = False) -> Iterator[list[int]]:
    """Return a context that collects Ctrl-C, SIGTERM and SIGHUP in a list; at its end, the first signal is handled.

    If the program has no handler for this signal, the context raises SystemExit. After Interrupted is raised, further
    signals are ignored.

    Args:
        insist: Whether a second signal is handled immediately instead of being collected.

    Raises:
        Interrupted: A signal arrived within the context, and ``signals`` handles it.
        SystemExit: A signal arrived within the context, and the program has no handler for it.
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
