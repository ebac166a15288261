"""Run in studio as a plugin: show the session's frames, and send back the person's commands."""

import time
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np

from lyceum_warp.viewer.protocol import Frame, Opened, Reply, Scene
from lyceum_warp.viewer.window import studio
from lyceum_warp.viewer.window.actions import Actions
from lyceum_warp.viewer.window.mouse import Mouse
from lyceum_warp.viewer.window.scene import ExtraGeoms, ModelValues, ViewCameras
from lyceum_warp.viewer.window.studio import inputs, ux
from lyceum_warp.viewer.window.windows import Windows

SWAP_TIME = 0.5
"""Seconds between two models that are sent to the browser."""


class End(Protocol):
    """The window's end of the connection to the session."""

    def send(self, reply: Reply) -> None:
        """Send to the session."""

    def take(self) -> Frame | None:
        """The latest frame that was not taken yet."""


class Panel(studio.Plugin):  # type: ignore[misc]  # studio has no types
    """Draws frames with studio, and sends commands.

    Args:
        scene: What is shown.
        model: The scene's model.
        end: Where frames come from and commands go.
        screen: The viewer that runs this plugin.
        opened: Sent to the session when the window runs.
        limit: Maximum number of geoms of ghosts and traces.
    """

    def __init__(
        self,
        scene: Scene,
        model: mujoco.MjModel,
        end: End,
        screen: studio.Screen,
        opened: Opened,
        limit: int = studio.MAX_GEOMS,
    ) -> None:
        self.actions = Actions(scene, end.send)
        self.mouse = Mouse(end.send)
        self.values = ModelValues(model)
        self.windows = Windows(self.actions, self.values, limit)
        self._end, self._screen, self._opened, self._limit = end, screen, opened, limit
        self._geoms = ExtraGeoms(model, limit)
        self._swapped = -SWAP_TIME
        self._model_due = False

    # messages of studio

    @studio.handler
    def on_start(self, event: studio.Started) -> None:
        """The window runs."""
        ux.setup_theme(ux.GuiTheme.LIGHT)
        self.actions.viewer, self.actions.cameras = self.viewer, ViewCameras(self.viewer, self.values)
        self.actions.cameras.reset()
        self._end.send(self._opened)

    @studio.handler
    def on_update(self, event: studio.Update) -> None:
        """Before a frame is drawn: take the session's frame, then keys and the mouse."""
        frame = self._end.take()
        if frame is not None:
            self.take(frame)
        dropped = self.viewer.get_drop_file()  # studio only keeps a file that was dropped on the page or the window
        if dropped:
            title = self.actions.scene.title
            self.actions.say(f"{Path(dropped).name} was not loaded: this viewer shows {title} only")
        if self.actions.frame is None:
            return
        inputs.handle_mouse_events(
            self.viewer.model,
            self.viewer.data,
            self.viewer.camera,
            self.viewer.vis_options,
            self.viewer.perturb,
            self.actions.cameras.state,
            move_camera=self.viewer.client_camera is None,
        )
        self.actions.press_keys()
        self.mouse.drag(self.viewer, paused=self.actions.status.paused)

    @studio.handler
    def on_gui(self, event: studio.Gui) -> None:
        """Build the windows."""
        self.windows.draw()
        self.viewer.camera_index = self.actions.cameras.state.camera_index

    def take(self, frame: Frame) -> None:
        """Show a frame."""
        self.actions.frame = frame
        self._show_model(frame)
        model, data = self.viewer.model, self.viewer.data
        if frame.samples is not None:
            self.windows.curves.add(frame.samples)
        if frame.messages:
            self.actions.say(*frame.messages)
        # the session reports a state that is not finite as a fault; its last good pose stays
        if np.isfinite(frame.state).all():
            mujoco.mj_setState(model, data, frame.state, mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_forward(model, data)
        groups = np.array(self.viewer.vis_options.geomgroup)
        drawn = self._geoms.draw(frame.pose, frame.ghosts, frame.traces, frame.best, groups)
        self.windows.drawn = drawn
        self.viewer.extra_geoms[:] = drawn.geoms

    def _show_model(self, frame: Frame) -> None:
        """Set the world's values in the model that is drawn."""
        if self.values.differ(frame.model_fields):
            if self.values.set(frame.model_fields):
                self._model_due = True
            else:
                self.values.copy_to(self.viewer.model)
        if self._model_due and time.monotonic() > self._swapped + SWAP_TIME:
            self._swapped, self._model_due = time.monotonic(), False
            self._geoms = ExtraGeoms(self.values.model, self._limit)
            self._screen.show_model(self.values.model)
