"""A window in memory: it collects frames, and sends the commands of a test."""

import time
from collections import deque
from collections.abc import Callable, Iterable

import torch

from lyceum_warp.viewer.protocol import Command, Frame
from lyceum_warp.viewer.session.clock import Session


class MemoryWindow:
    """Shows nothing.

    Args:
        script: Called after each frame; returns commands. The window closes where it returns None.
        seconds: The test fails after this time.
    """

    def __init__(self, script: Callable[[Frame, int], Iterable[Command] | None], seconds: float = 60.0) -> None:
        self.script, self.end = script, time.monotonic() + seconds
        self.frames: list[Frame] = []
        self.pending: deque[Command] = deque()
        self.open = True
        self.closed = 0
        self.error: str | None = None

    def show(self, frame: Frame) -> None:
        self.frames.append(frame)
        commands = self.script(frame, len(self.frames) - 1)
        if commands is None:
            self.open = False
        else:
            self.pending.extend(commands)

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


def run(session: Session, *script: Iterable[Command] | Callable[[Frame], Iterable[Command] | None]) -> MemoryWindow:
    """Run a session: after each frame the next entry of the script. A function is called until it returns None."""
    entries = list(script)

    def after(frame: Frame, number: int) -> Iterable[Command] | None:
        while entries:
            entry = entries[0]
            if not callable(entry):
                entries.pop(0)
                return entry
            if (commands := entry(frame)) is not None:
                return commands
            entries.pop(0)
        return None

    window = MemoryWindow(after)
    session.run(window)
    assert window.closed == 1
    return window


def until(wanted: Callable[[Frame], bool]) -> Callable[[Frame], list[Command] | None]:
    return lambda frame: None if wanted(frame) else []


def pushing(obs: torch.Tensor) -> torch.Tensor:
    return 0.5 * torch.sign(obs[:, :3])
