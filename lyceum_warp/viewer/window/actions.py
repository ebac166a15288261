"""Turn keys and buttons into commands."""

import dataclasses
from collections import deque
from collections.abc import Callable
from typing import Any

from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.protocol import MOST_BURST, Command, Frame, Scene, Status
from lyceum_warp.viewer.window.scene import ViewCameras
from lyceum_warp.viewer.window.studio import imgui, inputs, ux

SPEEDS = tuple(2.0**power for power in range(-4, 5))
"""The speeds that the user can choose, in simulated seconds per second of wall time."""
MANY_STEPS = 50
"""Shift+Right and Shift+Left move by this many steps."""

_DRIVING = tuple(getattr(imgui.Key, name) for name in "WSADQE")  # forward, back, left, right, turn left, turn right

KEY_NAMES = {"Right": "RightArrow", "Left": "LeftArrow", "Up": "UpArrow", "Down": "DownArrow"}
"""Maps the panel's names of keys to ImGui's names."""


class Actions:
    """Stores the user's choices, and sends the corresponding commands."""

    def __init__(self, scene: Scene, do: Callable[[Command], None]) -> None:
        self.scene, self.do = scene, do
        self.frame: Frame | None = None
        self.viewer: Any
        self.cameras: ViewCameras
        self.windows = {"messages", *(["curves"] if scene.curves else [])}
        self.messages: deque[str] = deque(maxlen=200)
        self.scroll_down = False
        self._keys = key_table()
        self._steering = (0.0, 0.0, 0.0)  # the last command that the keys gave

    @property
    def status(self) -> Status:
        """The session's status, which is unknown before the first frame."""
        assert self.frame is not None
        return self.frame.status

    def say(self, *messages: str) -> None:
        """Add lines to the messages."""
        self.messages.extend(messages)
        self.scroll_down = True

    def press_keys(self) -> None:
        """Handle pressed keys."""
        io = imgui.GetIO()
        if io.WantCaptureKeyboard:
            return
        for key in self._keys:
            *held, name = key.name.split("+")
            code = getattr(imgui.Key, KEY_NAMES.get(name, name))
            if [io.KeyCtrl, io.KeyShift] == ["Ctrl" in held, "Shift" in held] and imgui.IsKeyPressed(code, key.repeat):
                key.action(self)
                return
        if self.status.driven and any(map(imgui.IsKeyDown, _DRIVING)):
            return
        viewer, flying = self.viewer, self.cameras.state.camera_index == ux.FREE_CAMERA_IDX
        if not io.KeyCtrl:
            inputs.handle_vis_options_keyboard_events(viewer.vis_options, flying)
        if flying and viewer.client_camera is None:
            _, viewer.cam_speed = ux.move_camera_with_keys(viewer.model, viewer.camera, viewer.cam_speed)

    def drive_by_keys(self) -> None:
        """Send a velocity command when the user presses or releases W, A, S, D, Q or E."""
        if self.scene.speeds is None or not self.status.driven or imgui.GetIO().WantCaptureKeyboard:
            return
        ahead, back, left, right, anticlockwise, clockwise = (bool(imgui.IsKeyDown(key)) for key in _DRIVING)
        forward, lateral, turn = self.scene.speeds
        command = (ahead - back) * forward, (left - right) * lateral, (anticlockwise - clockwise) * turn
        if command != self._steering:
            self._steering = command
            self.do(protocol.Drive(command))

    def toggle_driving(self) -> None:
        """Let the user drive, or let the task choose commands again."""
        if self.scene.speeds is not None:
            self.do(protocol.Drive(None if self.status.driven else (0.0, 0.0, 0.0)))

    def change_mode(self, by: int) -> None:
        """Change to the next or the previous mode."""
        modes = self.scene.modes
        self.do(protocol.SetMode(modes[(modes.index(self.status.mode) + by) % len(modes)]))

    def change_controller(self, by: int) -> None:
        """Change to the next or the previous controller."""
        names = self.scene.controllers
        if names:
            now = names.index(self.status.controller) if self.status.controller in names else -by
            self.do(protocol.SetMode("controller", controller=names[(now + by) % len(names)]))

    def change_shown(self, by: int) -> None:
        """Show the next or the previous world or episode."""
        if self.status.mode == "playback":
            episode = ((self.status.episode or 0) + by) % len(self.scene.episodes)
            self.do(protocol.SetMode("playback", episode=episode))
        else:
            self.do(protocol.SetWorld("next" if by > 0 else "previous"))

    def change_speed(self, by: int) -> None:
        """Double or halve the speed."""
        now = SPEEDS.index(self.status.speed)
        self.do(protocol.SetSpeed(SPEEDS[min(max(now + by, 0), len(SPEEDS) - 1)]))

    def set_ghosts(self, **changes: Any) -> None:
        """Change settings of the ghosts."""
        self.do(dataclasses.replace(self.status.ghosts, **changes))

    def toggle_video(self) -> None:
        """Start a video from the view's camera, or end the video."""
        self.do(protocol.SetVideo(self.cameras.view() if self.status.video is None else None))

    def take_picture(self) -> None:
        """Write a picture from the view's camera."""
        self.do(protocol.TakePicture(self.cameras.view()))

    def toggle_window(self, title: str) -> None:
        """Open or close a window of the panel."""
        self.windows ^= {title}


@dataclasses.dataclass(frozen=True)
class Key:
    """A key and its action."""

    name: str
    what: str
    action: Callable[["Actions"], None]
    repeat: bool = False


def key_table() -> list[Key]:
    """List the keys of the panel. Browsers pass all of them on to the page."""
    return [
        Key("F1", "show or hide this table", lambda p: p.toggle_window("keys")),
        Key("F2", "messages", lambda p: p.toggle_window("messages")),
        Key("F3", "curves", lambda p: p.toggle_window("curves")),
        Key("Space", "pause or continue", lambda p: p.do(protocol.SetPaused(not p.status.paused))),
        Key("Right", "a step", lambda p: p.do(protocol.StepBy(1)), repeat=True),
        Key("Left", "a step back", lambda p: p.do(protocol.StepBy(-1)), repeat=True),
        Key("Shift+Right", f"{MANY_STEPS} steps", lambda p: p.do(protocol.StepBy(MANY_STEPS)), repeat=True),
        Key("Shift+Left", f"{MANY_STEPS} steps back", lambda p: p.do(protocol.StepBy(-MANY_STEPS)), repeat=True),
        Key("Ctrl+Right", "next mode", lambda p: p.change_mode(1)),
        Key("Ctrl+Left", "previous mode", lambda p: p.change_mode(-1)),
        Key("Ctrl+Down", "next controller", lambda p: p.change_controller(1)),
        Key("Ctrl+Up", "previous controller", lambda p: p.change_controller(-1)),
        Key("Down", "next world, or next episode of a playback", lambda p: p.change_shown(1), repeat=True),
        Key("Up", "previous world or episode", lambda p: p.change_shown(-1), repeat=True),
        Key("Shift+Up", "double the speed", lambda p: p.change_speed(1)),
        Key("Shift+Down", "halve the speed", lambda p: p.change_speed(-1)),
        Key("Backspace", "reset", lambda p: p.do(protocol.Reset(random=False))),
        Key("Shift+Backspace", "random reset", lambda p: p.do(protocol.Reset(random=True))),
        Key("Ctrl+R", "reverse the playback", lambda p: p.do(protocol.SetBackwards(not p.status.backwards))),
        Key("Ctrl+B", "burst: many states at once",
            lambda p: p.set_ghosts(burst=0 if p.status.ghosts.burst else MOST_BURST // 2)),
        Key("Enter", "drive a walking robot: W A S D move it, Q E turn it", lambda p: p.toggle_driving()),
        Key("Ctrl+V", "start or end a video and a page that plays it", lambda p: p.toggle_video()),
        Key("Ctrl+P", "take a picture", lambda p: p.take_picture()),
        Key("Ctrl+A", "look at everything", lambda p: p.cameras.reset()),
        Key("Escape", "free camera", lambda p: p.cameras.choose(ux.TUMBLE_CAMERA_IDX)),
    ]  # fmt: skip


OTHER_KEYS = (
    ("0 to 5", "groups of geoms, with Shift groups of sites"),
    ("letters", "MuJoCo's flags, such as T transparent, C contacts, F forces, J joints, M centre of mass"),
    ("left, right button", "drag to rotate or move the camera; the wheel zooms"),
    ("double-click left", "choose a body"),
    ("Ctrl + right, left button", "drag to push or twist that body; while paused, to place or turn it"),
    ("double-click right", "look at a point, with Ctrl follow the body"),
)
"""The keys and mouse actions that studio handles."""
