"""Run the window process, which ``session/window_process.py`` starts.

The process draws; it neither steps nor plans. It imports mujoco and NumPy, and of this package only ``viewer/window``
and ``viewer/protocol.py``: torch and Warp would cost seconds and hundreds of megabytes.
"""

import contextlib
import os
import signal
import threading
import time
from multiprocessing.connection import Connection

import mujoco

from lyceum_warp.viewer.protocol import Close, Failed, Frame, Opened, Opening, Reply, Taken, latest
from lyceum_warp.viewer.window import studio
from lyceum_warp.viewer.window.panel import Panel

IDLE_TIME = 0.25
"""Seconds between two frames while no person looks."""
NICE = 5
"""How much drawing gives way to the session, whose planner or training may need every core."""
END_TIME = 3.0
"""Seconds in which studio must end."""


class WindowEnd:
    """The window's end of the connection.

    One thread receives frames, and the thread that draws takes the latest one. Both may send.
    """

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._lock = threading.Lock()
        self._frame: Frame | None = None
        self._looked = 0.0
        self._parent = os.getppid()

    def first(self) -> Opening:
        """Wait for the first message."""
        opening: Opening = self._connection.recv()
        return opening

    def send(self, reply: Reply) -> None:
        """Send to the session; without effect after its end."""
        with self._lock, contextlib.suppress(OSError):
            self._connection.send(reply)

    def take(self) -> Frame | None:
        """The latest frame that was not taken yet, for a person who looks."""
        self._looked = time.monotonic()
        with self._lock:
            frame, self._frame = self._frame, None
        return frame

    def receive(self) -> None:
        """Receive frames until the session ends."""
        while True:
            try:
                if not self._connection.poll(1.0):
                    if os.getppid() != self._parent:  # a fork of the session may hold the connection open
                        return
                    continue
                frame = self._connection.recv()
            except (EOFError, OSError):
                return
            with self._lock:
                self._frame = latest(self._frame, frame)
            if time.monotonic() - self._looked > IDLE_TIME:
                time.sleep(IDLE_TIME)
            self.send(Taken())


def main(descriptor: int) -> None:
    """Open the window, and draw until the session or the person ends it.

    Args:
        descriptor: File descriptor of the connection to the session.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the session handles Ctrl-C, and ends the window
    if hasattr(os, "nice"):  # not on Windows
        os.nice(NICE)
    end = WindowEnd(Connection(descriptor))
    try:
        run(end)
        end.send(Close())
    except Exception as error:
        kind = "" if isinstance(error, RuntimeError) else f"{type(error).__name__}: "
        end.send(Failed(" ".join(f"{kind}{error}".split())))
        raise


def run(end: WindowEnd) -> None:
    """Run studio with the panel."""
    opening = end.first()
    with contextlib.ExitStack() as ends:
        proxy = sock = None
        opened = Opened()
        if opening.graphics == "web":
            from lyceum_warp.viewer.window.proxy import Proxy  # loads aiohttp
            from lyceum_warp.viewer.window.sockets import private_socket

            try:
                proxy = ends.enter_context(Proxy(host=opening.host, port=opening.port))
            except ValueError as error:
                return end.send(Failed(str(error), refused=True))
            sock = private_socket()
            opened = Opened(proxy.address, tuple(proxy.instructions))
        model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": opening.scene.model})
        screen = studio.Screen()
        limit = studio.MAX_GEOMS if opening.graphics == "web" else studio.NATIVE_GEOMS
        panel = Panel(opening.scene, model, end, screen, opened, limit)

        def follow() -> None:
            end.receive()
            screen.close()
            time.sleep(END_TIME)
            os._exit(1)

        threading.Thread(target=follow, daemon=True).start()
        screen.show_model(model)
        if proxy and sock:
            proxy.start(sock.getsockname(), on_quiet=panel.mouse.let_go)
            if opening.browser:
                proxy.open_in_browser()
        screen.run(panel, gfx=opening.graphics, title=opening.scene.title, sock=sock)
