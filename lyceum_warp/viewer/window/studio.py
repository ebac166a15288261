"""Wrap mujoco.studio in one module, because its interface may still change.

Studio renders a scene and a panel in a browser, and handles keys and the mouse. Studio's stepping, history and model
loading are not used, because the simulation is in another process.
"""

import time
from typing import Any

import mujoco
from mujoco.studio import launch_thread, messages, plugin, ux, viewer_protocol, web_viewer
from mujoco.studio.app import inputs
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot
from mujoco.studio.web import state_payload, web_server

from lyceum_warp.viewer.window.server import FRAMES, PageServer, PrivateSocket

__all__ = [
    "MAX_GEOMS", "Gui", "Plugin", "Screen", "Started", "Update", "handler", "imgui", "implot",
    "inputs", "ux",
]  # fmt: skip

IDLE = 0.1
"""Seconds between two looks at the session's messages while no page is visible."""
REPEAT = 1.0
"""Seconds after which an equal state is sent again. A page without new states soon reports that it is disconnected."""
MAX_GEOMS: int = state_payload.MAX_EXTRA_GEOMS
"""Maximum number of geoms that a browser shows in addition to the model's."""

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
        self._viewer_end, self._sim_end = launch_thread.make_thread_endpoints()

    def show_model(self, model: mujoco.MjModel) -> None:
        """Show a copy of another model."""
        self._sim_end.send_to_viewer(messages.ModelEvent(model=model))

    def close(self) -> None:
        """End ``run``."""
        self._sim_end.send_to_viewer(messages.ExitEvent())

    def run(self, panel: Any, *, title: str, server: PageServer) -> None:
        """Run until ``close`` is called."""
        replaced: list[str] = []

        def private(*place: Any) -> PrivateSocket:
            replaced.append("socket")
            return PrivateSocket()

        # studio would serve everyone: on every address, and on a loopback port that other users can use
        web_server.bind_public_socket = web_server.bind_loopback_socket = private
        web_server.serve = server.serve
        web_server.WebServer = WebServer
        config = viewer_protocol.ViewerConfig(title=title, gfx="web", open_browser=False)
        viewer = _Viewer(config, self._viewer_end, plugins=[panel], server=server)
        if len(replaced) < 2:
            viewer.close()
            raise RuntimeError(f"mujoco.studio {mujoco.__version__} would listen on every address of this machine")
        viewer_protocol.run_viewer_loop(viewer)


class WebServer(web_server.WebServer):  # type: ignore[misc]  # studio has no types
    """Sends a new state, or an equal one after REPEAT seconds, if fewer than FRAMES states wait to be drawn."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        vars(web_server).update(_STATE_MAX_IN_FLIGHT=FRAMES)  # studio has no option for this number
        self._next = 0.0  # when an equal state is sent again
        super().__init__(*arguments, **options)

    def update_state(self, payload: bytes) -> None:
        """Replace the state that pages draw next."""
        if payload != self._state_payload or time.monotonic() >= self._next:
            self._next = time.monotonic() + REPEAT
            super().update_state(payload)


class _Viewer(web_viewer.WebViewer):  # type: ignore[misc]  # studio has no types
    """A viewer that makes a frame for each frame of the browser, and none if no page is visible."""

    def __init__(self, *arguments: Any, server: PageServer, **options: Any) -> None:
        self._server = server
        super().__init__(*arguments, **options)

    def prepare_next_frame(self) -> bool:
        return self._server.take_frame(IDLE) and super().prepare_next_frame()
