"""A window in memory: it collects frames, and sends the commands of a test."""

import time
from collections import deque
from collections.abc import Callable, Iterable

from lyceum_warp.viewer.protocol import Command, Frame


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
