"""What several commands share: values on the command line and in config.json, and how a program is asked to end."""

import ast
import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any


class Interrupted(BaseException):
    """A signal asks the program to end."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextlib.contextmanager
def signals() -> Iterator[None]:
    """Ctrl-C and SIGTERM raise Interrupted, once: a second one does not disturb the goodbye."""

    def interrupt(number: int, frame: Any) -> None:
        for other in previous:
            signal.signal(other, signal.SIG_IGN)
        raise Interrupted(number)

    previous: dict[int, Any] = {}
    try:
        for number in (int(signal.SIGINT), int(signal.SIGTERM)):
            # whoever started us in the background with SIGINT ignored means it
            if signal.getsignal(number) is not signal.SIG_IGN:
                previous[number] = signal.signal(number, interrupt)
    except ValueError:  # not the main thread: signals are somebody else's
        pass
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def portable(task: str) -> str:
    """A task's file with its whole path, so that the run can be used from another folder."""
    path, colon, attribute = task.partition(":")
    return f"{Path(path).resolve()}{colon}{attribute}" if path.endswith(".py") else task


def parameter(text: str) -> tuple[str, Any]:
    """A parameter of a task as it is given, NAME=VALUE, a vector as NAME=0.7,inf.

    Raises:
        ValueError: It is written otherwise.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ValueError(f"a parameter is given as NAME=VALUE, not {text!r}")
    parts = [_value(part, text) for part in value.strip().strip("[]()").split(",") if part.strip()]
    if not parts:
        raise ValueError(f"a parameter is given as NAME=VALUE, not {text!r}")
    return name.strip(), parts[0] if len(parts) == 1 else parts


def _value(part: str, text: str) -> bool | int | float:
    part = part.strip()
    if part.lower() in ("true", "false"):
        return part.lower() == "true"
    try:
        value = ast.literal_eval(part)
        return value if isinstance(value, (bool, int)) else float(part)
    except (ValueError, SyntaxError, TypeError):
        pass
    try:
        return float(part)  # inf
    except ValueError:
        raise ValueError(f"the value in {text!r} is no number, true or false") from None


def spelled(value: Any) -> str:
    """A value as `parameter` reads it."""
    return ",".join(map(str, value)) if isinstance(value, (list, tuple)) else str(value)
