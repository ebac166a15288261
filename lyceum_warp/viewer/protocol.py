"""Define the messages between the session process, which owns the worlds, and the window process, which shows them.

Messages are pickled. This module imports only NumPy, because the window process never loads torch or Warp.
"""

import dataclasses
from typing import Literal, TypeAlias

import numpy as np

Mode: TypeAlias = Literal["passive", "controller", "playback"]

Owner: TypeAlias = Literal["planner", "task", "physics"]
"""The owner of a number that the user can change."""

Velocity: TypeAlias = tuple[float, float, float]
"""Forward velocity (m/s), lateral velocity (m/s) and yaw rate (rad/s)."""

MOST_GHOSTS = 32
"""Maximum number of other worlds that are shown at once."""
MOST_BURST = 50
"""Maximum number of states along a trajectory that are shown at once."""

TRACE_COLOUR = (0.6, 0.65, 0.75, 0.5)
BEST_COLOUR = (0.1, 0.75, 0.3, 1.0)

MAX_POINTS, MAX_MESSAGES = 20_000, 200
"""Maximum number of curve points and of messages in one frame."""


# messages to the window


@dataclasses.dataclass(frozen=True)
class Scene:
    """The constant data of a session."""

    title: str
    model: bytes
    nworld: int
    modes: tuple[Mode, ...]
    controllers: tuple[str, ...]
    episodes: tuple[str, ...]
    curves: tuple[str, ...]
    """The names of the curves: "reward", "eval" and the task's metrics."""
    speeds: Velocity | None = None
    """The velocities of the driving keys, or None if the robot cannot be driven. Sliders reach twice these values."""
    sees: bool = False
    """Whether cameras render pictures for a policy."""
    clips: tuple[int, ...] = ()
    """The number of frames of each clip of a tracking task."""


@dataclasses.dataclass(frozen=True)
class Ghost:
    """An additional state to show, for example of another world."""

    state: np.ndarray
    """The state, in the format of ``Frame.state``."""
    colour: tuple[float, float, float, float] | None
    """Red, green, blue and opacity, from 0 to 1, or None for the model's own colours."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Shift in x and y, in metres."""
    what: str = ""
    """The ghost's line in the legend. Ghosts that the user need not tell apart have one line."""


@dataclasses.dataclass(frozen=True)
class Arrow:
    """An arrow in the scene, such as a commanded velocity."""

    start: np.ndarray
    """(3,), in metres."""
    end: np.ndarray
    colour: tuple[float, float, float, float]
    what: str = ""
    """The arrow's line in the legend."""


@dataclasses.dataclass(frozen=True)
class Ghosts:
    """The choice of ghosts."""

    worlds: int = 0
    """The number of other worlds to show as ghosts."""
    grid: bool = False
    """Whether to show the other worlds side by side."""
    burst: int = 0
    """The maximum number of ghosts along the trajectory. Past states are red, and future states are blue."""
    plan: bool = True
    """Whether to show the plan's final pose and the traces of the samples."""


@dataclasses.dataclass(frozen=True)
class Status:
    """The contents of the window's panel."""

    mode: Mode
    controller: str | None
    episode: int | None
    world: int
    step: int
    steps: int
    """The number of steps of the playback's episode, or the task's horizon."""
    time: float
    """Simulated seconds since the start of the episode."""
    paused: bool
    speed: float
    """Simulated seconds per second of wall time."""
    measured_speed: float
    """The measured speed, or NaN while paused."""
    plan_ms: float
    """The duration of the controller's last call, in milliseconds, or NaN before the first call."""
    backwards: bool
    video: str | None
    ghosts: Ghosts = Ghosts()
    command: Velocity | None = None
    driven: bool = False
    """Whether the command comes from the user instead of the task."""
    planner: tuple[tuple[str, float], ...] = ()
    params: tuple[tuple[str, float], ...] = ()
    physics: tuple[tuple[str, float], ...] = ()
    """Model fields of the displayed world, as multiples of the nominal model's."""
    seekable: tuple[int, int] = (0, 0)
    """The first and the last step on the slider."""
    clip: tuple[int, int, int] | None = None
    """The clip of new episodes (-1 if it is drawn), and the clip and the frame of the displayed world."""
    text: tuple[tuple[str, str], ...] = ()
    """Additional lines of the panel. Each is a name with a value."""
    pictures: bool = False
    """Whether the pictures for a policy are shown."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """The displayed world at one moment."""

    state: np.ndarray
    """The state for ``mujoco.mj_setState`` with ``mjSTATE_INTEGRATION``, float64."""
    model_fields: dict[str, np.ndarray]
    """The flattened values, by name, of the model fields that may differ between worlds."""
    status: Status
    ghosts: tuple[Ghost, ...] = ()
    traces: np.ndarray | None = None
    """The paths of the planner's samples, (samples, points, 3), in metres. The first one is the best."""
    arrows: tuple[Arrow, ...] = ()
    points: np.ndarray | None = None
    """The points of all curves, (points, 2 + curves): the simulated time in seconds, whether an episode ended (0 or 1),
    and a value for each curve."""
    predicted: np.ndarray | None = None
    """The rewards that the plan predicts, (horizon + 1, 2): simulated seconds from now on, and rewards."""
    messages: tuple[str, ...] = ()
    """Messages about ended episodes, faults and refused commands."""
    files: tuple[str, ...] = ()
    """Absolute paths of new videos, pages and pictures to offer for download."""
    pictures: tuple[tuple[str, str], ...] | None = None
    """Captions and data URLs of new pictures for a policy, or None to keep the last ones."""


# messages of the window, besides its commands


@dataclasses.dataclass(frozen=True)
class Opened:
    """Reports that the window is open."""

    instructions: tuple[str, ...]
    """The lines to print. The first one contains the address."""


@dataclasses.dataclass(frozen=True)
class Failed:
    """Reports that the window ended with an error."""

    reason: str
    refused: bool = False
    """Whether the host or the port was invalid or in use."""


@dataclasses.dataclass(frozen=True)
class Taken:
    """Reports that the window has begun to render a frame, and is ready for the next one."""
