"""Run the window process: receive frames, show them with studio, and send commands.

The process does not import torch and Warp, which would cost seconds and hundreds of megabytes.
"""

import contextlib
import os
import signal
import threading
import time
from multiprocessing.connection import Connection

import mujoco

from lyceum_warp.viewer.commands import Command, close, command
from lyceum_warp.viewer.protocol import Failed, Frame, Opened, Scene, Taken
from lyceum_warp.viewer.window import studio
from lyceum_warp.viewer.window.panel import Panel
from lyceum_warp.viewer.window.server import PageServer


class WindowEnd:
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


def main(descriptor: int) -> None:
    """Show frames until the session or the user closes the window. ``descriptor`` is the connection to the session."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the session handles Ctrl-C, and then ends this process
    os.nice(5)  # the session's planner may need every core
    connection = Connection(descriptor)
    end = WindowEnd(connection)
    try:
        run(end, *connection.recv())
        end.send(command(close))
    except Exception as error:
        kind = "" if isinstance(error, RuntimeError) else f"{type(error).__name__}: "
        end.send(Failed(" ".join(f"{kind}{error}".split())))
        raise


def run(end: WindowEnd, scene: Scene, host: str, port: int | None) -> None:
    """Run studio with the panel."""
    try:
        server = PageServer(host=host, port=port, title=scene.title)
    except ValueError as error:
        return end.send(Failed(str(error), refused=True))
    model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": scene.model})
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_size[planes, :2] = 0.0  # studio shows planes of size 0 as infinite
    screen = studio.Screen()
    panel = Panel(scene, model, end.send, end.take, screen, Opened(tuple(server.instructions)), server.offer)
    server.on_quiet = panel.mouse.let_go

    def follow() -> None:
        end.receive()
        screen.close()
        time.sleep(3.0)
        os._exit(1)  # end the process even if studio hangs

    threading.Thread(target=follow, daemon=True).start()
    screen.show_model(model)
    screen.run(panel, title=scene.title, server=server)
