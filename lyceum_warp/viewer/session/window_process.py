"""Start the window process, send it frames, and collect its commands."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from lyceum_warp.viewer.protocol import (
    Close,
    Command,
    Failed,
    Frame,
    Graphics,
    Opened,
    Opening,
    Reply,
    Scene,
    Taken,
    latest,
)

FRAME_TIME = 1 / 60
"""Seconds between two frames at least."""
OPENING_TIME = 60.0
"""Seconds in which the process must report that the window runs."""
CLOSING_TIME = 5.0
"""Seconds in which it must end."""

_PROGRAM = """
import sys
sys.path.append(sys.argv[2])  # for a package that is not installed
from lyceum_warp.viewer.window.main import main
main(int(sys.argv[1]))
"""


class Window:
    """Shows frames, and takes the commands of the person who looks at them.

    The window's process is not a fork and does not import the caller's program, so no guard of ``__main__`` is needed.
    It ends with this process, however this one ends; Ctrl-C does not reach it.

    Args:
        scene: What is shown.
        gfx: "web" serves a page for browsers, which needs no display; "native" opens a window.
        host: Address on which the page is served. Other machines reach it only under another one than the default.
        port: Port of the page; by default the first free one from 8080 on.
        browser: Whether to open the page in this machine's browser.

    Raises:
        ValueError: The port is out of range or in use, or the address is not one of this machine.
        RuntimeError: The window cannot be opened; the message holds the reason.
    """

    def __init__(
        self,
        scene: Scene,
        gfx: Graphics = "web",
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        browser: bool = False,
    ) -> None:
        if gfx not in ("web", "native"):
            raise ValueError(f"gfx must be 'web' or 'native', not {gfx!r}")
        self._pending: Frame | None = None
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._taken = threading.Semaphore(0)
        self._next = 0.0
        self._ended = False
        self._commands: deque[Command] = deque()
        self._threads: list[threading.Thread] = []
        self._log = tempfile.TemporaryFile()  # noqa: SIM115  # closed in close()
        self._socket, theirs = socket.socketpair()
        self._connection = Connection(os.dup(self._socket.fileno()))
        with theirs:
            self._process = subprocess.Popen(
                # -P: the current folder is not searched for modules
                [sys.executable, "-P", "-c", _PROGRAM, str(theirs.fileno()), str(Path(__file__).parents[3])],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=self._log,
                stderr=self._log,
                process_group=0,  # the terminal sends Ctrl-C to its own group only
            )
        self.error: str | None = None
        """Why the window ended, where that was an error."""
        self.address = ""
        """The page's address, which holds its secret; empty without a page."""
        self.instructions: tuple[str, ...] = ()
        """Lines to print: where the page is, and how another machine reaches it."""
        try:
            self._connection.send(Opening(scene, gfx, host, port, browser))
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
            raise RuntimeError(f"the viewer's window cannot be opened: {reason}")
        self.address, self.instructions = reply.address, reply.instructions
        for target in (self._send, self._receive):
            self._threads.append(threading.Thread(target=target, daemon=True, name="lyceum-viewer"))
            self._threads[-1].start()

    def show(self, frame: Frame) -> None:
        """Show a frame instead of the one before. The call does not wait for the window.

        Where frames come faster than they are drawn, only the latest one is drawn, with the curves' points and the
        messages of all.
        """
        with self._lock:
            self._pending = latest(self._pending, frame)
        self._wake.set()

    @property
    def wants_frame(self) -> bool:
        """Whether the frame before is on its way: the caller may save the work of making frames until then.

        True about 60 times a second while a person looks, and four times a second otherwise.
        """
        return self._pending is None and time.monotonic() >= self._next and not self._ended

    def commands(self) -> list[Command]:
        """The commands since the last call, in order."""
        return [self._commands.popleft() for _ in range(len(self._commands))]

    def is_open(self) -> bool:
        """Whether the window's process runs."""
        return not self._ended

    def close(self) -> None:
        """End the window's process. A second call does nothing."""
        self._end()
        with contextlib.suppress(OSError):  # wakes both threads and the process
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        try:
            self._process.wait(CLOSING_TIME)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for thread in self._threads:  # its end of the connection must not be closed while a thread reads from it
            thread.join(CLOSING_TIME)
        self._connection.close()
        self._log.close()

    def __enter__(self) -> "Window":
        return self

    def __exit__(self, *exception: Any) -> None:
        self.close()

    def _end(self) -> None:
        self._ended = True
        self._wake.set()
        self._taken.release()

    def _last_words(self) -> str:
        """How the process ended: the signal that ended it, or what it printed last."""
        code = self._process.returncode
        if code is None:
            return "its process closed the connection"
        if code < 0:
            return f"its process was ended by {signal.Signals(-code).name}"
        self._log.seek(0)
        lines = [line.strip() for line in self._log.read().decode(errors="replace").splitlines() if line.strip()]
        return lines[-1] if lines else f"its process ended with code {code}"

    def _send(self) -> None:
        """The thread that sends frames."""
        while True:
            self._wake.wait()
            if self._ended:
                return
            with self._lock:
                frame, self._pending = self._pending, None
                self._wake.clear()
                self._next = float("inf")
            if frame is None:
                continue
            try:
                self._connection.send(frame)
            except (OSError, ValueError):
                return  # the thread that takes replies finds out why
            self._taken.acquire()
            self._next = time.monotonic()
            time.sleep(FRAME_TIME)

    def _receive(self) -> None:
        """The thread that takes replies."""
        closed = False
        try:
            while not self._ended:
                reply: Reply = self._connection.recv()
                if isinstance(reply, Taken):
                    self._taken.release()
                elif isinstance(reply, Failed):
                    self.error = reply.reason
                elif not isinstance(reply, Opened):
                    closed = closed or isinstance(reply, Close)
                    self._commands.append(reply)
        except (EOFError, OSError):
            if not self._ended and not closed and self.error is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(CLOSING_TIME)
                self.error = self._last_words()
        finally:
            self._end()
