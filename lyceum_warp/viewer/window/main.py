"""Run the window process: receive frames, show them with studio, and send commands.

The process does not import torch and Warp, which would cost seconds and hundreds of megabytes.
"""

import os
import signal
import threading
import time
from multiprocessing.connection import Connection

import mujoco

from lyceum_warp.viewer.commands import close, command
from lyceum_warp.viewer.protocol import Failed, Scene
from lyceum_warp.viewer.window import studio
from lyceum_warp.viewer.window.connection import SessionConnection
from lyceum_warp.viewer.window.panel import Panel
from lyceum_warp.viewer.window.server import PageServer

FLOOR_REPEATS = 1.0
"""Repetitions of a floor's texture per metre. Finer textures, such as Gymnasium's, look as if the robot stood still."""


def main(descriptor: int) -> None:
    """Show frames until the session or the user closes the window. ``descriptor`` is the connection to the session."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the session handles Ctrl-C, and then ends this process
    os.nice(5)  # the session's planner may need every core
    connection = Connection(descriptor)
    session = SessionConnection(connection)
    try:
        run(session, *connection.recv())
        session.send(command(close))
    except Exception as error:
        kind = "" if isinstance(error, RuntimeError) else f"{type(error).__name__}: "
        session.send(Failed(" ".join(f"{kind}{error}".split())))
        raise


def run(session: SessionConnection, scene: Scene, host: str, port: int | None) -> None:
    """Run studio with the panel."""
    try:
        server = PageServer(host=host, port=port, title=scene.title)
    except ValueError as error:
        return session.send(Failed(str(error), refused=True))
    model = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": scene.model})
    planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
    model.geom_size[planes, :2] = 0.0  # studio shows planes of size 0 as infinite
    floors = model.geom_matid[planes & (model.geom_matid >= 0)]
    model.mat_texuniform[floors], model.mat_texrepeat[floors] = True, FLOOR_REPEATS
    screen = studio.Screen()
    panel = Panel(scene, model, session, screen, server)

    def follow() -> None:
        session.receive()
        screen.close()
        time.sleep(3.0)
        os._exit(1)  # end the process even if studio hangs

    threading.Thread(target=follow, daemon=True).start()
    screen.show_model(model)
    screen.run(panel, title=scene.title, server=server)
