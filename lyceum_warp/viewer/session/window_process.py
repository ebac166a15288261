"""Start the window process, send it frames, and collect its commands."""

import contextlib
import multiprocessing
import signal
import subprocess
import sys
import tempfile
import threading
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from lyceum_warp.viewer.commands import Command, close
from lyceum_warp.viewer.protocol import Failed, Frame, Opened, Scene, Taken

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
        self.wants_frame = True
        """Whether the window is ready for a frame."""
        self.error: str | None = None
        self._ended = False
        self._commands: deque[Command] = deque()
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  # closed in close()
        self._sender = ThreadPoolExecutor(1, "lyceum-viewer")  # the window may be slow to receive a frame
        self._receiver = threading.Thread(target=self._receive, daemon=True, name="lyceum-viewer")
        self._connection, theirs = multiprocessing.Pipe()
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
        try:
            self._connection.send((scene, host, port))
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
        self.instructions = reply.instructions
        """The lines to print: the page's address, and the ssh command for other machines."""
        self.address = self.instructions[0].partition(" ")[2]
        self._receiver.start()

    def show(self, frame: Frame) -> None:
        """Send a frame without waiting for the window, if ``wants_frame`` is true."""
        if self.wants_frame:
            self.wants_frame = False
            self._sender.submit(self._connection.send, frame)

    def commands(self) -> list[Command]:
        """Return the commands since the last call, in order."""
        return [self._commands.popleft() for _ in range(len(self._commands))]

    def is_open(self) -> bool:
        """Whether the window process runs."""
        return not self._ended

    def close(self) -> None:
        """End the window process."""
        if self._connection.closed:
            return
        self._ended = True
        self.wants_frame = False
        self._sender.submit(self._connection.send, None)
        try:
            self._process.wait(CLOSING_TIME)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._sender.shutdown()
        if self._receiver.is_alive():
            self._receiver.join(CLOSING_TIME)
        self._connection.close()
        self._log.close()

    def _last_words(self) -> str:
        code = self._process.returncode
        if code is None:
            return "its process closed the connection"
        if code < 0:
            return f"its process was ended by {signal.Signals(-code).name}"
        self._log.seek(0)
        lines = self._log.read().decode(errors="replace").strip().splitlines()
        return lines[-1].strip() if lines else f"its process ended with code {code}"

    def _receive(self) -> None:
        closed = False
        try:
            while True:
                reply: Command | Failed | Taken = self._connection.recv()
                if isinstance(reply, Taken):
                    self.wants_frame = not self._ended
                elif isinstance(reply, Failed):
                    self.error = reply.reason
                else:
                    closed = closed or reply.function is close
                    self._commands.append(reply)
        except (EOFError, OSError):
            if not self._ended and not closed and self.error is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(CLOSING_TIME)
                self.error = self._last_words()
        self._ended = True
        self.wants_frame = False
