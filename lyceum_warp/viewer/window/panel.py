"""Connect studio with the session: show frames, and send the user's commands."""

import json
import time

import mujoco
import numpy as np

from lyceum_warp.viewer.commands import command, drive, set_watched
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
RATE_TIME, LEAST_PICTURES = 3.0, 5
"""The page's pictures are counted for this many seconds, and longer while a page that loads draws fewer."""
SLOW = 15.0
"""If the page draws fewer pictures per second, shadows and reflections are turned off, once."""


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
        self._looked: bool | None = None
        self._counted = (0.0, 0)  # when pictures were counted for the last time, and how many there were
        self._may_simplify = True
        server.on_look, server.on_gamepad = self.look, self.steer
        self.actions.tell = server.tell

    # messages of studio

    @studio.handler
    def on_start(self, event: studio.Started) -> None:
        """Start the window."""
        ux.setup_theme(ux.GuiTheme.LIGHT)
        self.actions.viewer, self.actions.cameras = self.viewer, ViewCameras(self.viewer, self.values)
        self.actions.cameras.reset()
        self._session.send(Opened(tuple(self._server.instructions)))
        self.look(False)

    # events of the page, in the server's thread

    def look(self, looks: bool) -> None:
        """Let the worlds run only while a page is visible."""
        if looks != self._looked:
            self._looked, self._counted = looks, (time.monotonic(), self._server.inputs)
            self._session.send(command(set_watched, looks))
        if not looks:
            self.mouse.let_go()

    def steer(self, axes: list[float]) -> None:
        """Drive a walking robot by a gamepad's axes: forwards, to the left, and turn to the left."""
        if self.actions.scene.speeds is not None:
            forward, left, turn = (axis * speed for axis, speed in zip(axes, self.actions.scene.speeds, strict=True))
            self.actions.do(drive, (forward, left, turn))

    def _count_pictures(self) -> None:
        since, before = self._counted
        seconds, pictures = time.monotonic() - since, self._server.inputs - before
        if seconds < RATE_TIME or pictures < LEAST_PICTURES:
            return
        rate = self.windows.page_rate = pictures / seconds
        self._counted = time.monotonic(), self._server.inputs
        if rate < SLOW and self._may_simplify:
            self._may_simplify = False
            flags = list(self.viewer.render_flags.flags)
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                flags[flag] = 0
            self.viewer.render_flags.flags = flags
            self.actions.say(
                f"the page draws {rate:.1f} pictures/s, so shadows and reflections are off (view, rendering)"
            )

    @studio.handler
    def on_update(self, event: studio.Update) -> None:
        """Show the newest frame, and handle keys and the mouse."""
        if (frame := self._session.take()) is not None:
            self.take(frame)
        if self.actions.frame is None:
            return
        self._count_pictures()
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
        if frame.pictures is not None:
            self._server.tell(f"pictures={json.dumps(frame.pictures)}")
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
