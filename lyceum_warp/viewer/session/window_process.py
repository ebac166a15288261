"""Start the window process, send it frames, and collect its commands."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections import deque
from multiprocessing.connection import Connection
from pathlib import Path

from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.protocol import Command, Failed, Frame, Opened, Scene

OPENING_TIME = 60.0
"""Maximum time until the window is open, in seconds."""
CLOSING_TIME = 5.0
"""Maximum time that the process may take to end, in seconds."""

_PROGRAM = """
import sys
sys.path.append(sys.argv[2])  # for a package that is not installed
from lyceum_warp.viewer.window.main import main
main(int(sys.argv[1]))
"""


class NoWindowError(OSError):
    """Raised if the window cannot be opened, or if it ends with an error. The message gives the reason."""


class Window:
    """Shows frames in a window process, and collects the user's commands.

    The window process does not import the caller's program, so the caller needs no ``__main__`` guard. The window
    process ends with this process, even after SIGKILL. Ctrl-C does not reach the window process.

    Raises:
        ValueError: The port is out of range or in use, or the address is not an address of this machine.
        NoWindowError: The window cannot be opened.
    """

    def __init__(self, scene: Scene, *, host: str = "127.0.0.1", port: int | None = None) -> None:
        self._pending: Frame | None = None
        self._taken = True
        self._changed = threading.Condition()  # the lock of _changed also guards _pending and _taken
        self._ended = False
        self._commands: deque[Command] = deque()
        self._threads: list[threading.Thread] = []
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  # closed in close()
        self._socket, theirs = socket.socketpair()
        self._connection = Connection(os.dup(self._socket.fileno()))
        with theirs:
            self._process = subprocess.Popen(
                # with -P, Python does not search the current folder for modules
                [sys.executable, "-P", "-c", _PROGRAM, str(theirs.fileno()), str(Path(__file__).parents[3])],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                process_group=0,  # a terminal sends Ctrl-C to a whole process group
            )
        self.error: str | None = None
        try:
            self._connection.send(protocol.Opening(scene, host, port))
            reply = self._connection.recv() if self._connection.poll(OPENING_TIME) else None
        except (EOFError, OSError):
            self._process.wait()
            reply = Failed(self._last_words())
        except BaseException:
            self.close()
            raise
        if not isinstance(reply, Opened):
            self.close()
            if isinstance(reply, Failed) and reply.refused:
                raise ValueError(reply.reason)
            reason = reply.reason if isinstance(reply, Failed) else f"its process did not start in {OPENING_TIME:.0f} s"
            raise NoWindowError(f"the viewer's window cannot be opened: {reason}")
        self.address = reply.address
        self.instructions = reply.instructions
        """The lines to print: the page's address, and the ssh command for other machines."""
        for target in (self._send, self._receive):
            self._threads.append(threading.Thread(target=target, daemon=True, name="lyceum-viewer"))
            self._threads[-1].start()

    def show(self, frame: Frame) -> None:
        """Send a frame without waiting for the window.

        An older frame that was not sent yet is skipped. The new frame then also holds the curve points and messages of
        the older frame.
        """
        with self._changed:
            self._pending = protocol.latest(self._pending, frame)
            self._changed.notify()

    @property
    def wants_frame(self) -> bool:
        """Whether the window is ready for a frame."""
        return self._taken and self._pending is None and not self._ended

    def commands(self) -> list[Command]:
        """Return the commands since the last call, in order."""
        return [self._commands.popleft() for _ in range(len(self._commands))]

    def is_open(self) -> bool:
        """Whether the window process runs."""
        return not self._ended

    def close(self) -> None:
        """End the window process."""
        self._end()
        with contextlib.suppress(OSError):  # this wakes both threads and the window process
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        try:
            self._process.wait(CLOSING_TIME)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for thread in self._threads:  # end the threads first, because they must not read from a closed connection
            thread.join(CLOSING_TIME)
        self._connection.close()
        self._log.close()

    def _end(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()

    def _last_words(self) -> str:
        code = self._process.returncode
        if code is None:
            return "its process closed the connection"
        if code < 0:
            return f"its process was ended by {signal.Signals(-code).name}"
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        return lines[-1].strip() if lines else f"its process ended with code {code}"

    def _send(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or (self._taken and self._pending is not None))
                if self._ended:
                    return
                frame, self._pending, self._taken = self._pending, None, False
            try:
                self._connection.send(frame)
            except (OSError, ValueError):
                return  # the receiving thread reports the reason

    def _receive(self) -> None:
        closed = False
        try:
            while not self._ended:
                reply: protocol.Reply = self._connection.recv()
                if isinstance(reply, protocol.Taken):
                    with self._changed:
                        self._taken = True
                        self._changed.notify()
                elif isinstance(reply, Failed):
                    self.error = reply.reason
                elif not isinstance(reply, Opened):
                    closed = closed or isinstance(reply, protocol.Close)
                    self._commands.append(reply)
        except (EOFError, OSError):
            if not self._ended and not closed and self.error is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(CLOSING_TIME)
                self.error = self._last_words()
        finally:
            self._end()
