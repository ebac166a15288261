"""Wrap mujoco.studio, whose interface is young: no other module imports it.

Studio draws a scene and a panel, in a browser or in a window, and hands over keys and the mouse. ``Screen.run`` opens
it with a plugin: an object derived from ``Plugin`` whose handlers take ``Started``, ``Update`` and ``Gui``. The
simulation is in another process, so studio's own stepping, history and loading of models are not used.
"""

import collections.abc
import os
import socket
import sys
from typing import Any, Literal

import mujoco
import numpy as np
from mujoco.studio import launch_native, launch_thread, launch_web, messages, plugin, ux, viewer_protocol
from mujoco.studio.app import inputs
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot
from mujoco.studio.web import state_payload, web_server

from lyceum_warp.viewer.window.sockets import private_socket

__all__ = [
    "MAX_GEOMS", "NATIVE_GEOMS", "Gui", "Plugin", "Screen", "Started", "Update", "handler", "imgui", "implot",
    "inputs", "ux",
]  # fmt: skip

MAX_GEOMS: int = state_payload.MAX_EXTRA_GEOMS
"""Geoms that a browser draws beside those of the model."""

Plugin: Any = plugin.ViewerPlugin
"""Base class of plugins: ``self.viewer`` is the viewer from ``Started`` on."""

handler: Any = messages.handler
"""Marks a method of a plugin that takes the message in its annotation."""

NATIVE_GRAPHICS = "opengl_software"
"""How a window is drawn: into memory. In mujoco 4.0.0 the other ways fail at the first frame ("Target not found")."""

NATIVE_GEOMS = 0
"""Geoms that a window draws beside those of the model. In mujoco 4.0.0 a single one ends its process (SIGSEGV)."""

Started: Any = plugin.ViewerInitEvent
Update: Any = messages.UpdateEvent
Gui: Any = messages.BuildGuiEvent


class Screen:
    """A viewer that runs, for other threads: ``show_model`` and ``close`` may be called at any time."""

    def __init__(self) -> None:
        self._viewer_end, self._own_end = launch_thread.make_thread_endpoints()

    def show_model(self, model: mujoco.MjModel) -> None:
        """Draw another model, which the viewer copies."""
        self._own_end.send_to_viewer(messages.ModelEvent(model=model))

    def close(self) -> None:
        """End ``run``."""
        self._own_end.send_to_viewer(messages.ExitEvent())

    def run(self, own: Any, *, gfx: Literal["web", "native"], title: str, sock: socket.socket | None = None) -> None:
        """Draw until ``close`` is called, or until a person closes the window.

        A browser gets the page from ``sock``, which must be bound.

        Raises:
            RuntimeError: if there is no display for a window, or if studio would listen on another socket.
        """
        config = viewer_protocol.ViewerConfig(
            title=title, gfx="web" if gfx == "web" else NATIVE_GRAPHICS, open_browser=False
        )
        if gfx == "native":
            if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
                raise RuntimeError('there is no display (DISPLAY is not set): show it in a browser, with gfx="web"')
            if not hasattr(collections.abc, "Buffer"):  # studio's renderer names a class of Python 3.12
                collections.abc.Buffer = np.ndarray  # type: ignore[attr-defined, unused-ignore]
            launch_native.run_native_viewer(config, self._viewer_end, plugins=[own])
            return
        assert sock is not None
        taken: list[bool] = []

        def bound(host: str, port: int = 0) -> socket.socket:
            taken.append(True)
            return sock

        # Studio listens on every address, and on a port of its own on the loopback address, which all users share.
        web_server.bind_public_socket = bound
        web_server.bind_loopback_socket = lambda port=0: private_socket()
        launch_web.run_web_viewer(config, self._viewer_end, plugins=[_Guard(taken), own])


class _Guard(Plugin):  # type: ignore[misc]  # studio has no types
    """Refuses to go on where studio did not take the given socket: it would listen to the whole network."""

    def __init__(self, taken: list[bool]) -> None:
        self.taken = taken

    @handler(priority=messages.Priority.CRITICAL)
    def on_start(self, event: Started) -> None:
        if not self.taken:
            raise RuntimeError(f"mujoco.studio {mujoco.__version__} would listen on every address of this machine")
