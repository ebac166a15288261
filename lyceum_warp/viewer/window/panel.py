"""Connect studio with the session: show frames, and send the user's commands."""

import time

import mujoco
import numpy as np

from lyceum_warp.viewer.protocol import Frame, Opened, Scene
from lyceum_warp.viewer.window import studio
from lyceum_warp.viewer.window.actions import Actions
from lyceum_warp.viewer.window.connection import SessionConnection
from lyceum_warp.viewer.window.mouse import Mouse
from lyceum_warp.viewer.window.scene import ExtraGeoms, ModelValues, ViewCameras
from lyceum_warp.viewer.window.server import PageServer
from lyceum_warp.viewer.window.studio import inputs, ux
from lyceum_warp.viewer.window.windows import Windows

SWAP_TIME = 0.5
"""Minimum seconds between two models that are sent to the browser."""


class Panel(studio.Plugin):  # type: ignore[misc]  # studio has no types
    """A plugin of studio that shows frames and sends commands."""

    def __init__(
        self, scene: Scene, model: mujoco.MjModel, session: SessionConnection, screen: studio.Screen, server: PageServer
    ) -> None:
        self.actions = Actions(scene, session.send)
        self.mouse = Mouse(session.send)
        self.values = ModelValues(model)
        self.windows = Windows(self.actions)
        self._session, self._screen, self._server = session, screen, server
        self._geoms = ExtraGeoms(model, studio.MAX_GEOMS)
        self._swapped = -SWAP_TIME
        self._model_due = False

    # messages of studio

    @studio.handler
    def on_start(self, event: studio.Started) -> None:
        """Start the window."""
        ux.setup_theme(ux.GuiTheme.LIGHT)
        self.actions.viewer, self.actions.cameras = self.viewer, ViewCameras(self.viewer, self.values)
        self.actions.cameras.reset()
        self._session.send(Opened(tuple(self._server.instructions)))

    @studio.handler
    def on_update(self, event: studio.Update) -> None:
        """Show the newest frame, and handle keys and the mouse."""
        if (frame := self._session.take()) is not None:
            self.take(frame)
        if self.actions.frame is None:
            return
        viewer = self.viewer
        inputs.handle_mouse_events(
            viewer.model, viewer.data, viewer.camera, viewer.vis_options, viewer.perturb, self.actions.cameras.state,
            move_camera=viewer.client_camera is None,
        )  # fmt: skip
        self.actions.drive_by_keys()
        self.actions.press_keys()
        self.mouse.drag(self.viewer, paused=self.actions.status.paused)

    @studio.handler
    def on_gui(self, event: studio.Gui) -> None:
        """Build the windows."""
        self.windows.build()
        self.viewer.camera_index = self.actions.cameras.state.camera_index

    def take(self, frame: Frame) -> None:
        """Show a frame."""
        self.actions.frame = frame
        self._show_model(frame)
        model, data = self.viewer.model, self.viewer.data
        if frame.points is not None:
            self.windows.curves.add(frame.points)
        for file in frame.files:
            self._server.offer(file)
        if frame.messages:
            self.actions.say(*frame.messages)
        # if the state is not finite, keep the previous pose; the session reports the fault
        if np.isfinite(frame.state).all():
            mujoco.mj_setState(model, data, frame.state, mujoco.mjtState.mjSTATE_INTEGRATION)
            mujoco.mj_forward(model, data)
        self.viewer.extra_geoms[:] = self._geoms.of(frame, np.array(self.viewer.vis_options.geomgroup))

    def _show_model(self, frame: Frame) -> None:
        changed, visible = self.values.set(frame.model_fields)
        if visible:
            self._model_due = True
        elif changed:
            self.values.copy_to(self.viewer.model)
        if self._model_due and time.monotonic() > self._swapped + SWAP_TIME:
            self._swapped, self._model_due = time.monotonic(), False
            self._geoms = ExtraGeoms(self.values.model, studio.MAX_GEOMS)
            self._screen.show_model(self.values.model)
