"""Wrap mujoco.studio in one module, because its interface may still change.

Studio draws a scene and a panel in a browser, and handles keys and the mouse. Studio's stepping, history and model
loading are not used, because the simulation is in another process.
"""

import socket
from typing import Any

import mujoco
from mujoco.studio import launch_thread, launch_web, messages, plugin, ux, viewer_protocol
from mujoco.studio.app import inputs
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot
from mujoco.studio.web import state_payload, web_server

from lyceum_warp.viewer.window.sockets import private_socket

__all__ = [
    "MAX_GEOMS", "Gui", "Plugin", "Screen", "Started", "Update", "handler", "imgui", "implot",
    "inputs", "ux",
]  # fmt: skip

MAX_GEOMS: int = state_payload.MAX_EXTRA_GEOMS
"""Maximum number of geoms that a browser draws in addition to the model's."""

Plugin: Any = plugin.ViewerPlugin
"""The base class of plugins. A plugin can use ``self.viewer`` after the event ``Started``."""

handler: Any = messages.handler
"""Decorator for a plugin's method that handles messages. The method's annotation gives the type of the messages."""

Started: Any = plugin.ViewerInitEvent
Update: Any = messages.UpdateEvent
Gui: Any = messages.BuildGuiEvent


class Screen:
    """A viewer. Any thread may call ``show_model`` and ``close`` at any time."""

    def __init__(self) -> None:
        self._viewer_end, self._own_end = launch_thread.make_thread_endpoints()

    def show_model(self, model: mujoco.MjModel) -> None:
        """Draw a copy of another model."""
        self._own_end.send_to_viewer(messages.ModelEvent(model=model))

    def close(self) -> None:
        """End ``run``."""
        self._own_end.send_to_viewer(messages.ExitEvent())

    def run(self, own: Any, *, title: str, sock: socket.socket) -> None:
        """Draw until ``close`` is called."""
        config = viewer_protocol.ViewerConfig(title=title, gfx="web", open_browser=False)
        taken: list[bool] = []

        def bound(host: str, port: int = 0) -> socket.socket:
            taken.append(True)
            return sock

        # by default, studio listens on every address, and on a loopback port that other processes can use
        web_server.bind_public_socket = bound
        web_server.bind_loopback_socket = lambda port=0: private_socket()
        launch_web.run_web_viewer(config, self._viewer_end, plugins=[_Guard(taken), own])


class _Guard(Plugin):  # type: ignore[misc]  # studio has no types
    """Raises an error if studio does not use the given socket. Its own socket would listen on every address."""

    def __init__(self, taken: list[bool]) -> None:
        self.taken = taken

    @handler(priority=messages.Priority.CRITICAL)
    def on_start(self, event: Started) -> None:
        if not self.taken:
            raise RuntimeError(f"mujoco.studio {mujoco.__version__} would listen on every address of this machine")
