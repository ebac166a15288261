"""Connect the window process to the session."""

import contextlib
import os
import threading
from multiprocessing.connection import Connection

from lyceum_warp.viewer.commands import Command
from lyceum_warp.viewer.protocol import Failed, Frame, Opened, Taken


class SessionConnection:
    """The window process's connection to the session.

    One thread receives frames, and the rendering thread gets them from ``take``. The session sends a frame only after
    the window has taken the previous one.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._frame: Frame | None = None
        self._parent = os.getppid()

    def send(self, reply: Command | Failed | Opened | Taken) -> None:
        """Send a message to the session, unless the session has ended."""
        with self._sending, contextlib.suppress(OSError):
            self._connection.send(reply)

    def take(self) -> Frame | None:
        """Return the latest frame, or None if it was already returned."""
        if (frame := self._frame) is not None:
            self._frame = None  # no other frame arrives before this one is acknowledged
            self.send(Taken())
        return frame

    def receive(self) -> None:
        """Receive frames until the session closes the window or ends."""
        with contextlib.suppress(EOFError, OSError):
            while os.getppid() == self._parent:  # a forked child of the session may hold the connection open
                if self._connection.poll(1.0):
                    self._frame = self._connection.recv()
                    if self._frame is None:
                        return
