"""Define the messages between the session process, which owns the worlds, and the window process, which draws them.

Messages are pickled dataclasses. This module imports only NumPy, because the window process never loads torch or Warp.
"""

import dataclasses
from typing import Any, Literal, TypeAlias

import numpy as np

Mode: TypeAlias = Literal["passive", "controller", "playback"]

WorldChoice: TypeAlias = int | Literal["next", "previous", "best", "worst"]
"""The number of a world, or a rule that selects one. "best" and "worst" compare the returns of unfinished episodes."""

MOST_GHOSTS = 32
"""Maximum number of other worlds or episodes that are drawn at once."""
MOST_BURST = 50
"""Maximum number of states along a trajectory that are drawn at once."""

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
    speeds: tuple[float, float, float] | None = None
    """The forward velocity (m/s), lateral velocity (m/s) and yaw rate (rad/s) of the driving keys. Sliders reach twice
    these values. The value is None if the robot cannot be driven."""


@dataclasses.dataclass(frozen=True)
class Ghost:
    """An additional state to draw, for example of another world."""

    state: np.ndarray
    """The state, in the format of ``Frame.state``."""
    colour: tuple[float, float, float, float] | None
    """Red, green, blue and opacity, from 0 to 1, or None for the model's own colours."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Shift in x and y, in metres."""


@dataclasses.dataclass(frozen=True)
class Arrow:
    """An arrow in the scene, such as a commanded velocity."""

    start: np.ndarray
    """(3,), in metres."""
    end: np.ndarray
    colour: tuple[float, float, float, float]


@dataclasses.dataclass(frozen=True)
class SetGhosts:
    """Choose the ghosts to draw."""

    worlds: int = 0
    """The number of other worlds to show as ghosts."""
    grid: bool = False
    """Whether to show the other worlds side by side."""
    episodes: int = 0
    """The number of other saved episodes to show as ghosts. All ghosts are at the displayed step."""
    burst: int = 0
    """The maximum number of ghosts along the trajectory. Past states are red, and future states are blue."""
    plan: bool = True
    """Whether to draw the plan's final pose and the traces of the samples."""


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
    ghosts: SetGhosts = SetGhosts()
    command: tuple[float, float, float] | None = None
    """Forward velocity (m/s), lateral velocity (m/s) and yaw rate (rad/s)."""
    driven: bool = False
    """Whether the command comes from the user instead of the task."""
    planner: tuple[tuple[str, float], ...] = ()
    params: tuple[tuple[str, float], ...] = ()
    seekable: tuple[int, int] = (0, 0)
    """The first and the last step on the slider."""
    text: tuple[tuple[str, str], ...] = ()
    """Additional lines of the panel. Each is a name with a value."""


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
    """The paths of the planner's samples, (samples, points, 3), in metres."""
    best: int | None = None
    arrows: tuple[Arrow, ...] = ()
    samples: np.ndarray | None = None
    """The points of all curves, (points, 2 + curves): the simulated time in seconds, whether an episode ended (0 or 1),
    and a value for each curve."""
    messages: tuple[str, ...] = ()
    """Messages about ended episodes, faults and refused commands."""
    files: tuple[str, ...] = ()
    """Absolute paths of new videos, pages and pictures to offer for download."""


def latest(older: Frame | None, newer: Frame) -> Frame:
    """Merge the curve points, messages and files of a skipped frame into the newer frame."""
    if older is None or (older.samples is None and not older.messages and not older.files):
        return newer
    samples = [part for part in (older.samples, newer.samples) if part is not None]
    return dataclasses.replace(
        newer,
        samples=np.concatenate(samples)[-MAX_POINTS:] if samples else None,
        messages=(older.messages + newer.messages)[-MAX_MESSAGES:],
        files=older.files + newer.files,
    )


# commands


@dataclasses.dataclass(frozen=True)
class SetMode:
    """Change the mode, the controller or the episode."""

    mode: Mode
    controller: str | None = None
    episode: int | None = None


@dataclasses.dataclass(frozen=True)
class SetWorld:
    """Show another world."""

    world: WorldChoice


@dataclasses.dataclass(frozen=True)
class SetPaused:
    """Pause, or continue."""

    paused: bool


@dataclasses.dataclass(frozen=True)
class SetSpeed:
    """Change the speed."""

    speed: float
    """Simulated seconds per second of wall time, from 1/16 to 16."""


@dataclasses.dataclass(frozen=True)
class StepBy:
    """Pause, and make ``steps`` steps. A negative number steps back."""

    steps: int


@dataclasses.dataclass(frozen=True)
class Seek:
    """Pause, and show a step of the playback or of the world's history."""

    step: int


@dataclasses.dataclass(frozen=True)
class SetBackwards:
    """Set the direction of the playback."""

    backwards: bool


@dataclasses.dataclass(frozen=True)
class Reset:
    """Start a new episode of the displayed world."""

    random: bool


@dataclasses.dataclass(frozen=True)
class Perturb:
    """Push bodies, move a free body while paused, or move a mocap body at any time.

    Forces act until the next ``Perturb``. Forces of zero end the push.
    """

    forces: np.ndarray
    """Forces (N) and torques (Nm) in world coordinates, (nbody, 6) float64."""
    qpos: np.ndarray | None = None
    """New positions, (nq,) float64, which are ignored unless the session is paused."""
    mocap_pos: np.ndarray | None = None
    """New positions of mocap bodies, (nmocap, 3) float64, in metres."""
    mocap_quat: np.ndarray | None = None
    """New orientations of mocap bodies, (nmocap, 4) float64: w, x, y, z."""


@dataclasses.dataclass(frozen=True)
class Drive:
    """Command a walking robot."""

    command: tuple[float, float, float] | None
    """Forward velocity (m/s), lateral velocity (m/s) and yaw rate (rad/s). If the command is None, the task chooses its
    commands again."""


@dataclasses.dataclass(frozen=True)
class SetNumber:
    """Change a setting of the planner or a parameter of the task."""

    of: Literal["planner", "task"]
    name: str
    value: float


@dataclasses.dataclass(frozen=True)
class SetVideo:
    """Start a video, or end it."""

    camera: dict[str, Any] | None
    """The attributes of the ``mujoco.MjvCamera``, or None to end the video."""


@dataclasses.dataclass(frozen=True)
class TakePicture:
    """Write a picture of the scene."""

    camera: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Close:
    """End the session. Closing the page does not end the session, because the page can be opened again."""


Command: TypeAlias = (
    SetMode | SetWorld | SetPaused | SetSpeed | StepBy | Seek | SetBackwards | Reset | SetGhosts | Perturb | Drive
    | SetNumber | SetVideo | TakePicture | Close
)  # fmt: skip


# start and end


@dataclasses.dataclass(frozen=True)
class Opening:
    """The first message to the window process."""

    scene: Scene
    host: str
    port: int | None
    """By default the first free port from 8080."""


@dataclasses.dataclass(frozen=True)
class Opened:
    """Reports that the window is open."""

    address: str
    instructions: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Failed:
    """Reports that the window ended with an error."""

    reason: str
    refused: bool = False
    """Whether the host or the port was invalid or in use."""


@dataclasses.dataclass(frozen=True)
class Taken:
    """Reports that the window has begun to draw a frame, and is ready for the next one."""


Reply: TypeAlias = Opened | Failed | Taken | Command
