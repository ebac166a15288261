import time
from collections import deque
from collections.abc import Callable, Iterable

import torch

from lyceum_warp.viewer.commands import Command
from lyceum_warp.viewer.protocol import Frame
from lyceum_warp.viewer.session.clock import Session


class MemoryWindow:
    """A window that collects frames.

    ``script`` receives a frame and its number, and returns commands. A return value of None closes the window.
    """

    instructions: tuple[str, ...] = ()
    wants_frame = True
    error: str | None = None

    def __init__(self, script: Callable[[Frame, int], Iterable[Command] | None], seconds: float = 60.0) -> None:
        self.script, self.end = script, time.monotonic() + seconds
        self.frames: list[Frame] = []
        self.pending: deque[Command] = deque()
        self.open, self.closed = True, 0

    def show(self, frame: Frame) -> None:
        self.frames.append(frame)
        commands = self.script(frame, len(self.frames) - 1)
        self.open = commands is not None
        self.pending.extend(commands or ())

    def commands(self) -> list[Command]:
        assert time.monotonic() < self.end, "the session did not end"
        commands, self.pending = list(self.pending), deque()
        return commands

    def is_open(self) -> bool:
        return self.open

    def close(self) -> None:
        self.closed += 1

    @property
    def messages(self) -> list[str]:
        return [message for frame in self.frames for message in frame.messages]


def run(session: Session, *script: Iterable[Command] | Callable[[Frame], bool]) -> MemoryWindow:
    """Run a session. Each entry of ``script`` contains the commands of a frame, or is a condition to wait for."""
    entries = list(script)

    def after(frame: Frame, number: int) -> Iterable[Command] | None:
        while entries and callable(condition := entries[0]):
            if not condition(frame):
                return []
            entries.pop(0)
        return entries.pop(0) if entries else None  # type: ignore[return-value]

    window = MemoryWindow(after)
    session.run(window)  # type: ignore[arg-type]
    assert window.closed == 1
    return window


def pushing(obs: torch.Tensor) -> torch.Tensor:
    return 0.5 * torch.sign(obs[:, :3])
