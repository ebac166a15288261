"""The keys of the panel."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import mujoco

from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.window.studio import imgui, ux

Panel: TypeAlias = Any
"""A ``Panel``, whose module imports this one."""

MANY_STEPS = 50
"""Steps of the arrow keys with Shift."""

KEY_NAMES = {
    "Right": "RightArrow", "Left": "LeftArrow", "Up": "UpArrow", "Down": "DownArrow", "[": "LeftBracket",
    "]": "RightBracket", "-": "Minus", "=": "Equal",
}  # fmt: skip
"""Studio's names of keys that have others here."""


@dataclasses.dataclass(frozen=True)
class Key:
    """A key with what it does."""

    name: str
    what: str
    action: Callable[[Panel], None]
    repeat: bool = False
    """Whether holding it repeats it."""

    @property
    def code(self) -> Any:
        """Studio's name of the key, without Ctrl and Shift."""
        last = self.name.rpartition("+")[2]
        return getattr(imgui.Key, KEY_NAMES.get(last, last))

    @property
    def ctrl(self) -> bool:
        """Whether it is pressed with Ctrl."""
        return "Ctrl+" in self.name

    @property
    def shift(self) -> bool:
        """Whether it is pressed with Shift."""
        return "Shift+" in self.name


def key_table() -> list[Key]:
    """The keys of the panel: Lyceum's, where a browser leaves them to the page."""
    frames, labels = int(mujoco.mjtFrame.mjNFRAME), int(mujoco.mjtLabel.mjNLABEL)

    def turn(panel: Panel, option: str, by: int, number: int) -> None:
        options = panel.viewer.vis_options
        setattr(options, option, (getattr(options, option) + by) % number)

    return [
        Key("F1", "show or hide this table", lambda p: p.toggle_window("keys")),
        Key("F2", "messages", lambda p: p.toggle_window("messages")),
        Key("F3", "curves", lambda p: p.toggle_window("curves")),
        Key("F4", "plain drawing, for slow browsers", lambda p: p.draw_plainly()),
        Key("Tab", "fold or unfold the panel", lambda p: p.toggle_fold()),
        Key("Space", "pause or go on", lambda p: p.do(protocol.SetPaused(not p.status.paused))),
        Key("Right", "a step", lambda p: p.do(protocol.StepBy(1)), repeat=True),
        Key("Left", "a step back", lambda p: p.do(protocol.StepBy(-1)), repeat=True),
        Key("Shift+Right", f"{MANY_STEPS} steps", lambda p: p.do(protocol.StepBy(MANY_STEPS)), repeat=True),
        Key("Shift+Left", f"{MANY_STEPS} steps back", lambda p: p.do(protocol.StepBy(-MANY_STEPS)), repeat=True),
        Key("Ctrl+Right", "next mode", lambda p: p.change_mode(1)),
        Key("Ctrl+Left", "mode before", lambda p: p.change_mode(-1)),
        Key("Ctrl+Down", "next controller", lambda p: p.change_controller(1)),
        Key("Ctrl+Up", "controller before", lambda p: p.change_controller(-1)),
        Key("Down", "next world, or next episode of a playback", lambda p: p.change_shown(1), repeat=True),
        Key("Up", "world or episode before", lambda p: p.change_shown(-1), repeat=True),
        Key("Shift+Up", "double the speed", lambda p: p.change_speed(1)),
        Key("Shift+Down", "halve the speed", lambda p: p.change_speed(-1)),
        Key("Enter", "real time, or the speed before", lambda p: p.toggle_slow()),
        Key("Backspace", "reset", lambda p: p.do(protocol.Reset(random=False))),
        Key("Shift+Backspace", "random reset", lambda p: p.do(protocol.Reset(random=True))),
        Key("Ctrl+R", "reverse the playback", lambda p: p.do(protocol.SetBackwards(not p.status.backwards))),
        Key("Ctrl+B", "burst: many states at once", lambda p: p.toggle_burst()),
        Key("Ctrl+D", "burst in colours: past red, future blue", lambda p: p.set_ghosts(doppler=not p.ghosts.doppler)),
        Key("Ctrl+V", "begin or end a video", lambda p: p.toggle_video()),
        Key("Ctrl+A", "look at everything", lambda p: p.cameras.reset()),
        Key("Escape", "free camera", lambda p: p.cameras.choose(ux.TUMBLE_CAMERA_IDX)),
        Key("PageDown", "next camera", lambda p: p.cameras.change(1)),
        Key("PageUp", "camera before", lambda p: p.cameras.change(-1)),
        Key("[", "frames of the next kind", lambda p: turn(p, "frame", 1, frames)),
        Key("]", "frames of the kind before", lambda p: turn(p, "frame", -1, frames)),
        Key("-", "labels of the next kind", lambda p: turn(p, "label", 1, labels)),
        Key("=", "labels of the kind before", lambda p: turn(p, "label", -1, labels)),
    ]  # fmt: skip


OTHER_KEYS = (
    ("0 to 5", "groups of geoms, with Shift groups of sites"),
    ("letters", "MuJoCo's flags, such as T transparent, C contacts, F forces, J joints, M centre of mass"),
    ("drag left, right", "rotate or move the camera; the wheel zooms"),
    ("double-click left", "choose a body"),
    ("Ctrl + drag right, left", "push or twist that body; while paused, place it"),
    ("double-click right", "look at a point, with Ctrl follow the body"),
)
"""What studio does itself."""
