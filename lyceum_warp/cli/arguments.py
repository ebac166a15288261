"""What several commands share: values on the command line and in config.json, and how a program is asked to end."""

import ast
import contextlib
import dataclasses
import signal
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

Words = tyro.conf.UseAppendAction[tuple[str, ...]]
"""What may be given several times."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Physics:
    """How the worlds are simulated."""

    integrator: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Another integrator than the model's: euler, rk4, implicit or implicitfast."""
    solver: Annotated[Words, tyro.conf.arg(metavar="NAME=VALUE")] = ()
    """Another limit of the constraint solver than the model's, as iterations=4, ls_iterations=10 or
    noslip_iterations=0; may be given several times."""
    deterministic: bool = False
    """Whether runs on a GPU are equal to the bit, at many times the cost; on the CPU they are anyway."""
    unroll: bool = False
    """Whether the Warp engine goes through all iterations of the solver instead of a loop that ends early, which may
    gain a few percent on a GPU: with --solver iterations=4 or the like."""

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> "Physics":
        """That of a run; one from before there was a choice has the model's own."""
        saved = dict(config.get("physics", {}))
        if "solver" in saved:
            saved["solver"] = tuple(f"{name}={limit}" for name, limit in saved["solver"].items())
        return cls(**saved)

    def options(self) -> dict[str, Any]:
        """As an environment takes it."""
        return dataclasses.asdict(self) | {"solver": dict(map(parameter, self.solver))}

    def given(self) -> dict[str, Any]:
        """The same without what was not given: a planner then has what the task suggests."""
        return {name: value for name, value in self.options().items() if value not in (None, {}, False)}


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

    previous = _handled_by(interrupt)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def postponed(when: bool = True) -> Iterator[list[int]]:
    """Within ``signals``: Ctrl-C and SIGTERM are noted in the list, for who raises Interrupted at a better time.

    What is still noted at the end raises it there. Once it is raised, later signals are ignored.

    Args:
        when: False leaves signals alone.

    Raises:
        Interrupted: A signal came that nobody asked the list about.
    """
    noted: list[int] = []
    previous = _handled_by(lambda number, frame: noted.append(number)) if when else {}
    try:
        yield noted
    except Interrupted:
        previous = dict.fromkeys(previous, signal.SIG_IGN)
        raise
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    if noted:
        signal.raise_signal(signal.Signals(noted[0]))


def _handled_by(handler: Callable[[int, Any], None]) -> dict[int, Any]:
    """Handle Ctrl-C and SIGTERM, and return who did before."""
    previous: dict[int, Any] = {}
    with contextlib.suppress(ValueError):  # not the main thread: signals are somebody else's
        for number in (int(signal.SIGINT), int(signal.SIGTERM)):
            # whoever started us in the background with SIGINT ignored means it
            if signal.getsignal(number) is not signal.SIG_IGN:
                previous[number] = signal.signal(number, handler)
    return previous


def portable(task: str) -> str:
    """A task's file with its whole path, so that the run can be used from another folder."""
    path, colon, attribute = task.partition(":")
    return f"{Path(path).resolve()}{colon}{attribute}" if path.endswith(".py") else task


def parameter(text: str) -> tuple[str, Any]:
    """A parameter of a task, or a limit of the solver, as it is given: NAME=VALUE, a vector as NAME=0.7,inf.

    Raises:
        ValueError: It is written otherwise.
    """
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        raise ValueError(f"{text!r} has to be written as NAME=VALUE")
    parts = [_value(part, text) for part in value.strip().strip("[]()").split(",") if part.strip()]
    if not parts:
        raise ValueError(f"{text!r} has to be written as NAME=VALUE")
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
