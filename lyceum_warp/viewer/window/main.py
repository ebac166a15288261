"""The window's process: ``python window_process.py DESCRIPTOR``, which ``window.py`` starts.

The process draws; it neither steps nor plans. So it loads the files of the viewer without the package around them,
whose imports take seconds and hundreds of megabytes.
"""

import contextlib
import importlib.machinery
import os
import signal
import sys
import threading
import time
import types
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lyceum_warp.viewer.link import Opening, Reply
    from lyceum_warp.viewer.protocol import Frame

IDLE_TIME = 0.25
"""Seconds between two frames while no person looks."""
NICE = 5
"""How much drawing gives way to the session, whose planner or training may need every core."""
END_TIME = 3.0
"""Seconds in which studio must end."""


def load_only_viewer() -> None:
    """Make ``lyceum_warp.viewer`` importable without running ``lyceum_warp/__init__.py``."""
    folder = Path(__file__).resolve().parents[2]
    for name, place in (("lyceum_warp", folder), ("lyceum_warp.viewer", folder / "viewer")):
        module = types.ModuleType(name)
        module.__path__ = [str(place)]
        module.__spec__ = importlib.machinery.ModuleSpec(name, None, is_package=True)
        sys.modules[name] = module


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

    def first(self) -> "Opening":
        """Wait for the first message."""
        opening: Opening = self._connection.recv()
        return opening

    def send(self, reply: "Reply") -> None:
        """Send to the session; without effect after its end."""
        with self._lock, contextlib.suppress(OSError):
            self._connection.send(reply)

    def take(self) -> "Frame | None":
        """The latest frame that was not taken yet, for a person who looks."""
        self._looked = time.monotonic()
        with self._lock:
            frame, self._frame = self._frame, None
        return frame

    def receive(self) -> None:
        """Receive frames until the session ends."""
        from lyceum_warp.viewer.link import Taken, latest

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
    """Open the window, and draw until the session or the person ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the session handles Ctrl-C, and ends the window
    if hasattr(os, "nice"):  # not on Windows
        os.nice(NICE)
    load_only_viewer()
    from lyceum_warp.viewer.link import Failed
    from lyceum_warp.viewer.protocol import Close

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
    import mujoco

    from lyceum_warp.viewer.link import Failed, Opened
    from lyceum_warp.viewer.window import studio
    from lyceum_warp.viewer.window.panel import Panel
    from lyceum_warp.viewer.window.proxy import Front
    from lyceum_warp.viewer.window.sockets import private_socket

    opening = end.first()
    front = sock = None
    opened = Opened()
    if opening.graphics == "web":
        try:
            front = Front(host=opening.host, port=opening.port)
        except ValueError as error:
            return end.send(Failed(str(error), refused=True))
        sock = private_socket()
        opened = Opened(front.address, tuple(front.instructions))
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
    with front or contextlib.nullcontext():
        if front and sock:
            front.start(sock.getsockname(), on_quiet=panel.let_go)
            if opening.browser:
                front.open_in_browser()
        screen.run(panel, gfx=opening.graphics, title=opening.scene.title, sock=sock)


if __name__ == "__main__":
    main(int(sys.argv[1]))
