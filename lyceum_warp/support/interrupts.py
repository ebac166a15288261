"""Ctrl-C, SIGTERM and SIGHUP as an exception, at once or postponed until the caller handles it."""

import contextlib
import signal
from collections.abc import Callable, Iterator
from typing import Any

_NUMBERS = [int(getattr(signal, name)) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
"""Ctrl-C, SIGTERM and SIGHUP, which Windows lacks."""


class Interrupted(BaseException):
    """A signal asks the program to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextlib.contextmanager
def signals() -> Iterator[None]:
    """Within the context the first Ctrl-C, SIGTERM or SIGHUP raises Interrupted; later ones only within ``obeyed``."""

    def interrupt(number: int, frame: Any) -> None:
        for other in previous:
            signal.signal(other, _ignore)
        raise Interrupted(number)

    previous = _handled_by(interrupt)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def ending() -> Iterator[None]:
    """Within the context SIGTERM and SIGHUP raise SystemExit, unless the program handles them.

    By default they end a program at once, without its ``finally`` blocks.
    """

    def leave(number: int, frame: Any) -> None:
        raise SystemExit(128 + number)

    previous: dict[int, Any] = {}
    with contextlib.suppress(ValueError):  # only the main thread may set handlers
        for number in _NUMBERS[1:]:
            if signal.getsignal(number) is signal.SIG_DFL:
                previous[number] = signal.signal(number, leave)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def obeyed() -> Iterator[None]:
    """Within the context one more Ctrl-C, SIGTERM or SIGHUP raises Interrupted, after that of ``signals``.

    It is for work at the end of a program that may take long, so that a second Ctrl-C gives it up.
    """

    def interrupt(number: int, frame: Any) -> None:
        for other in numbers:
            signal.signal(other, _ignore)
        raise Interrupted(number)

    numbers = [number for number in _NUMBERS if signal.getsignal(number) is _ignore]
    with contextlib.suppress(ValueError):  # only the main thread may set handlers
        for number in numbers:
            signal.signal(number, interrupt)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            for number in numbers:
                signal.signal(number, _ignore)


@contextlib.contextmanager
def postponed(*, insist: bool = False) -> Iterator[list[int]]:
    """Within the block, list Ctrl-C, SIGTERM and SIGHUP; the first is handled at the end of the block.

    Once Interrupted is raised, later signals are ignored.

    Args:
        insist: Whether a second signal is handled at once.

    Raises:
        Interrupted: A signal came, and the caller did not raise it.
    """
    noted: list[int] = []

    def note(number: int, frame: Any) -> None:
        if noted and insist:
            noted.clear()
            signal.signal(number, previous[number])
            signal.raise_signal(signal.Signals(number))
        else:
            noted.append(number)

    previous = _handled_by(note)
    try:
        yield noted
    except Interrupted:
        previous = dict.fromkeys(previous, _ignore)
        raise
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if noted:
        signal.raise_signal(signal.Signals(noted[0]))


def _ignore(number: int, frame: Any) -> None:
    """Handles a signal after Interrupted was raised.

    It is not SIG_IGN, by which a shell makes a program ignore a signal, also in ``obeyed``.
    """


def _handled_by(handler: Callable[[int, Any], None]) -> dict[int, Any]:
    """Handle Ctrl-C, SIGTERM and SIGHUP, and return their previous handlers."""
    previous: dict[int, Any] = {}
    with contextlib.suppress(ValueError):  # only the main thread may set handlers
        for number in _NUMBERS:
            # a shell that starts a program in the background makes it ignore SIGINT on purpose, and nohup SIGHUP
            if signal.getsignal(number) not in (signal.SIG_IGN, _ignore):
                previous[number] = signal.signal(number, handler)
    return previous
