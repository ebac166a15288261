"""List the user's actions with their keys, and send the corresponding commands."""

import dataclasses
import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec

import mujoco

from lyceum_warp.viewer import commands
from lyceum_warp.viewer.commands import Command
from lyceum_warp.viewer.protocol import MOST_BURST, MOST_GHOSTS, Frame, Scene, Status
from lyceum_warp.viewer.window.scene import ViewCameras
from lyceum_warp.viewer.window.studio import imgui, inputs, ux

P = ParamSpec("P")

SPEEDS = tuple(2.0**power for power in range(-4, 5))
"""The speeds that the user can choose, in simulated seconds per second of wall time."""
MANY_STEPS = 50
"""Shift+Right and Shift+Left move by this many steps."""

_DRIVING_KEYS = tuple(getattr(imgui.Key, name) for name in "WSADQE")


class Actions:
    """Stores the user's choices, and sends the corresponding commands."""

    def __init__(self, scene: Scene, send: Callable[[Command], None]) -> None:
        self.scene, self._send = scene, send
        self.frame: Frame | None = None
        self.viewer: Any
        self.cameras: ViewCameras
        self.tell: Callable[[str], object]
        self.windows = {"curves"} if scene.curves else set()
        self.messages: deque[str] = deque(maxlen=200)
        self.scroll_down = False
        self.said = self.acted = -math.inf  # times of the last message and of the last command
        self._steering = (0.0, 0.0, 0.0)  # the last command that the keys gave

    @property
    def status(self) -> Status:
        """The session's status, which is unknown before the first frame."""
        assert self.frame is not None
        return self.frame.status

    def do(self, function: Callable[Concatenate[Any, P], None], *arguments: P.args, **options: P.kwargs) -> None:
        """Send a command: a function of ``commands.py`` with its arguments."""
        self.acted = time.monotonic()
        self._send(Command(function, arguments, options))

    def say(self, *messages: str) -> None:
        """Add lines to the messages."""
        self.messages.extend(messages)
        self.said, self.scroll_down = time.monotonic(), True

    def press_keys(self) -> None:
        """Handle pressed keys."""
        io = imgui.GetIO()
        if io.WantCaptureKeyboard:
            return
        for key, action in ACTIONS.items():
            *modifiers, name = key.split("+")
            code = getattr(imgui.Key, f"{name}Arrow" if name in ("Right", "Left", "Up", "Down") else name)
            held = [io.KeyCtrl, io.KeyShift] == ["Ctrl" in modifiers, "Shift" in modifiers]
            if held and imgui.IsKeyPressed(code, action.repeat):
                action.act(self)
                return
        if self.status.driven and any(map(imgui.IsKeyDown, _DRIVING_KEYS)):
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
        ahead, back, left, right, anticlockwise, clockwise = (bool(imgui.IsKeyDown(key)) for key in _DRIVING_KEYS)
        forward, lateral, turn = self.scene.speeds
        velocity = (ahead - back) * forward, (left - right) * lateral, (anticlockwise - clockwise) * turn
        if velocity != self._steering:
            self._steering = velocity
            self.do(commands.drive, velocity)

    def toggle_driving(self) -> None:
        """Let the user drive, or let the task choose commands again."""
        if self.scene.speeds is not None:
            self.do(commands.drive, None if self.status.driven else (0.0, 0.0, 0.0))

    def change_mode(self, by: int) -> None:
        """Change to the next or the previous mode."""
        modes = self.scene.modes
        self.do(commands.set_mode, modes[(modes.index(self.status.mode) + by) % len(modes)])

    def change_controller(self, by: int) -> None:
        """Change to the next or the previous controller."""
        names = self.scene.controllers
        if names:
            index = names.index(self.status.controller) if self.status.controller in names else -by
            self.do(commands.set_mode, "controller", controller=names[(index + by) % len(names)])

    def change_world(self, by: int) -> None:
        """Show the next or the previous world, or episode of a playback."""
        if self.status.mode == "playback":
            episode = ((self.status.episode or 0) + by) % len(self.scene.episodes)
            self.do(commands.set_mode, "playback", episode=episode)
        else:
            self.do(commands.set_world, "next" if by > 0 else "previous")

    def change_speed(self, by: int) -> None:
        """Double or halve the speed."""
        index = SPEEDS.index(self.status.speed) + by
        self.do(commands.set_speed, SPEEDS[min(max(index, 0), len(SPEEDS) - 1)])

    def set_ghosts(self, **changes: Any) -> None:
        """Change settings of the ghosts."""
        self.do(commands.set_ghosts, dataclasses.replace(self.status.ghosts, **changes))

    def toggle_contacts(self) -> None:
        """Show or hide contact points and forces."""
        flags = self.viewer.vis_options.flags
        shown = not flags[mujoco.mjtVisFlag.mjVIS_CONTACTFORCE]
        flags[mujoco.mjtVisFlag.mjVIS_CONTACTPOINT] = flags[mujoco.mjtVisFlag.mjVIS_CONTACTFORCE] = shown

    def toggles(self) -> dict[str, tuple[bool, Callable[[], object]]]:
        """What can be shown or hidden: whether it is shown, and a function that changes this."""
        ghosts, flags = self.status.ghosts, self.viewer.vis_options.flags
        most = min(self.scene.nworld - 1, MOST_GHOSTS)
        toggles: dict[str, tuple[bool, Callable[[], object]]] = {
            "contacts": (bool(flags[mujoco.mjtVisFlag.mjVIS_CONTACTFORCE]), self.toggle_contacts),
            "past": (ghosts.burst > 0, lambda: self.set_ghosts(burst=0 if ghosts.burst else MOST_BURST // 2)),
        }
        if most:
            toggles["ghosts"] = ghosts.worlds > 0, lambda: self.set_ghosts(worlds=0 if ghosts.worlds else most)
        if self.status.planner:
            toggles["plan"] = ghosts.plan, lambda: self.set_ghosts(plan=not ghosts.plan)
        if self.scene.sees:
            shown = self.status.pictures
            toggles["pictures"] = shown, lambda: self.do(commands.set_pictures, not shown)
        return toggles

    def toggle_video(self) -> None:
        """Start a video from the view's camera, or end the video."""
        self.do(commands.set_video, self.cameras.view() if self.status.video is None else None)


@dataclasses.dataclass(frozen=True)
class Action:
    """What a key or a button does."""

    what: str
    act: Callable[[Actions], object]
    icon: str = ""
    """The button's label. Without an icon, there is no button."""
    repeat: bool = False
    """Whether the action is repeated while the key is held down."""


ACTIONS = {
    "F1": Action("show or hide this table", lambda a: a.windows.symmetric_difference_update({"keys"})),
    "F2": Action("messages", lambda a: a.windows.symmetric_difference_update({"messages"})),
    "F3": Action("curves", lambda a: a.windows.symmetric_difference_update({"curves"})),
    "Backspace": Action("reset", lambda a: a.do(commands.reset, random=False), "\uf0e2"),
    "Shift+Backspace": Action("random reset", lambda a: a.do(commands.reset, random=True), "\uf074"),
    "Shift+Left": Action(
        f"{MANY_STEPS} steps back", lambda a: a.do(commands.step_by, -MANY_STEPS), "\uf04a", repeat=True
    ),
    "Left": Action("a step back", lambda a: a.do(commands.step_by, -1), "\uf048", repeat=True),
    "Space": Action("pause or continue", lambda a: a.do(commands.set_paused, not a.status.paused), "\uf04c"),
    "Right": Action("a step", lambda a: a.do(commands.step_by, 1), "\uf051", repeat=True),
    "Shift+Right": Action(f"{MANY_STEPS} steps", lambda a: a.do(commands.step_by, MANY_STEPS), "\uf04e", repeat=True),
    "Ctrl+Right": Action("next mode", lambda a: a.change_mode(1)),
    "Ctrl+Left": Action("previous mode", lambda a: a.change_mode(-1)),
    "Ctrl+Down": Action("next controller", lambda a: a.change_controller(1)),
    "Ctrl+Up": Action("previous controller", lambda a: a.change_controller(-1)),
    "Up": Action("previous world or episode", lambda a: a.change_world(-1), repeat=True),
    "Down": Action("next world, or next episode of a playback", lambda a: a.change_world(1), repeat=True),
    "Shift+Up": Action("double the speed", lambda a: a.change_speed(1)),
    "Shift+Down": Action("halve the speed", lambda a: a.change_speed(-1)),
    "Ctrl+R": Action("reverse the playback", lambda a: a.do(commands.set_backwards, not a.status.backwards)),
    "Ctrl+B": Action("many states of the episode at once", lambda a: a.toggles()["past"][1]()),
    "Enter": Action("drive a walking robot: W A S D move it, Q E turn it", lambda a: a.toggle_driving()),
    "Ctrl+V": Action("start or end a video and a page that plays it", lambda a: a.toggle_video(), "\uf03d  video"),
    "Ctrl+P": Action("take a picture", lambda a: a.do(commands.take_picture, a.cameras.view()), "\uf030  picture"),
    "Ctrl+A": Action("look at everything", lambda a: a.cameras.reset(), "look at everything"),
    "Escape": Action("free camera", lambda a: a.cameras.choose(ux.TUMBLE_CAMERA_IDX)),
}
"""The actions by their keys. Browsers pass all of these keys on to the page."""

MOUSE = (
    ("left, right button", "drag to rotate or move the camera; the wheel zooms"),
    ("double-click left", "choose a body"),
    ("Ctrl + right, left button", "drag to push or twist that body; while paused, to place or turn it"),
    ("double-click right", "look at a point, with Ctrl follow the body"),
)
OTHER_KEYS = (
    ("0 to 5", "groups of geoms, with Shift groups of sites"),
    ("letters", "MuJoCo's flags, such as T transparent, C contacts, F forces, J joints, M centre of mass"),
)
HELP = (*MOUSE, *((key, action.what) for key, action in ACTIONS.items()), *OTHER_KEYS)
"""What the mouse and all keys do. Studio handles the mouse and ``OTHER_KEYS``."""
