"""Define the messages between the session process, which owns the worlds, and the window process, which draws them.

Messages are pickled dataclasses. The window process never loads torch or Warp, so this module imports NumPy only.
"""

import dataclasses
from typing import Any, Literal, TypeAlias

import numpy as np

Mode: TypeAlias = Literal["passive", "controller", "playback"]

WorldChoice: TypeAlias = int | Literal["next", "previous", "best", "worst"]
"""A world's number, or a rule that finds it: the best and the worst by their returns so far."""

MOST_GHOSTS = 32
"""Maximum number of other worlds, and of other episodes, that are drawn at once."""
MOST_BURST = 50
"""Maximum number of states along a trajectory that are drawn at once."""

TRACE_COLOUR = (0.6, 0.65, 0.75, 0.5)
BEST_COLOUR = (0.1, 0.75, 0.3, 1.0)
"""Colours of a planner's samples and of the best sample, in the window and in videos."""

MAX_POINTS, MAX_MESSAGES = 20_000, 200
"""Maximum numbers of curve points and messages of skipped frames that the next frame contains."""


# from the session to the window


@dataclasses.dataclass(frozen=True)
class Scene:
    """The constant part of the display."""

    title: str
    """Title of the window."""
    model: bytes
    """The model, as ``mujoco.mj_saveModel`` writes it."""
    nworld: int
    modes: tuple[Mode, ...]
    """Available modes; the session starts in the first one."""
    controllers: tuple[str, ...]
    episodes: tuple[str, ...]
    """Names of the saved episodes."""
    curves: tuple[str, ...]
    """Names of the live curves: "reward", "eval" and the task's metrics."""
    speeds: tuple[float, float, float] | None = None
    """Largest forward and lateral velocity, m/s, and yaw rate, rad/s, of a robot that can be driven."""


@dataclasses.dataclass(frozen=True)
class Pose:
    """Positions of all bodies of one world."""

    qpos: np.ndarray
    """(nq,) float64."""
    mocap_pos: np.ndarray
    """(nmocap, 3) float64."""
    mocap_quat: np.ndarray
    """(nmocap, 4) float64."""


@dataclasses.dataclass(frozen=True)
class Ghost:
    """A further pose that is drawn."""

    pose: Pose
    colour: tuple[float, float, float, float] | None
    """Red, green, blue and opacity, each from 0 to 1; None for the model's own colours."""
    shift: tuple[float, float] = (0.0, 0.0)
    """Displacement of the drawn bodies from their positions, metres."""


@dataclasses.dataclass(frozen=True)
class Arrow:
    """An arrow in the scene."""

    start: np.ndarray
    """(3,), metres."""
    end: np.ndarray
    colour: tuple[float, float, float, float]


@dataclasses.dataclass(frozen=True)
class SetGhosts:
    """Choose which ghosts are drawn."""

    worlds: int = 0
    """Number of worlds to draw as ghosts, at most ``MOST_GHOSTS``, beginning after the shown world."""
    grid: bool = False
    """Whether these worlds are drawn beside each other, in their own colours."""
    episodes: int = 0
    """Number of episodes to draw as ghosts, at the same step, beginning after the shown episode."""
    burst: int = 0
    """Number of past (red) and future (blue) states along the trajectory, at most ``MOST_BURST``."""
    plan: bool = True
    """Whether the plan's final pose and the samples' traces are drawn."""


@dataclasses.dataclass(frozen=True)
class Status:
    """The contents of the panel."""

    mode: Mode
    controller: str | None
    episode: int | None
    """Index of the episode in playback."""
    world: int
    step: int
    """Step within the episode."""
    steps: int
    """Length of the episode in playback; otherwise the horizon, or 0 without a horizon."""
    time: float
    """Simulated seconds since the start of the episode."""
    paused: bool
    speed: float
    """Target speed, simulated seconds per second."""
    measured_speed: float
    """Measured speed; NaN while paused."""
    plan_ms: float
    """Milliseconds of the controller's last call; NaN before the first."""
    backwards: bool
    """Whether the playback runs backwards."""
    video: str | None
    """Name of the current video; None without one."""
    ghosts: SetGhosts = SetGhosts()
    """The ghosts that are drawn."""
    command: tuple[float, float, float] | None = None
    """Commanded forward and lateral velocity, m/s, and yaw rate, rad/s, of a walking robot."""
    driven: bool = False
    """Whether the user gave the command."""
    planner: tuple[tuple[str, float], ...] = ()
    """Names and values of the planner's settings that can be changed."""
    params: tuple[tuple[str, float], ...] = ()
    """Names and values of the task's parameters that can be changed."""
    seekable: tuple[int, int] = (0, 0)
    """First and last step of the slider."""
    text: tuple[tuple[str, str], ...] = ()
    """Further lines of the panel: names and values."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """The shown world at one moment."""

    pose: Pose
    state: np.ndarray
    """Argument of ``mujoco.mj_setState`` (``mjSTATE_INTEGRATION``), float64."""
    model_fields: dict[str, np.ndarray]
    """This world's model fields that differ from the model, by MuJoCo's names."""
    status: Status
    ghosts: tuple[Ghost, ...] = ()
    traces: np.ndarray | None = None
    """Paths of the planner's samples, (samples, points, 3), metres."""
    best: int | None = None
    """Index of the best sample."""
    arrows: tuple[Arrow, ...] = ()
    samples: np.ndarray | None = None
    """New points of the curves, (points, 2 + curves): simulated seconds, 1 if the episode ended, a value per curve."""
    messages: tuple[str, ...] = ()
    """New messages: ends of episodes, faults, refused commands."""
    files: tuple[str, ...] = ()
    """New videos, pages and pictures, as absolute paths, which the page offers for download."""


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


# from the window to the session: commands


@dataclasses.dataclass(frozen=True)
class SetMode:
    """Change the mode, the controller or the episode."""

    mode: Mode
    controller: str | None = None
    """Name of the controller; None keeps it."""
    episode: int | None = None
    """Index of the episode; None keeps it."""


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
    """Simulated seconds per second, 1/16 to 16."""


@dataclasses.dataclass(frozen=True)
class StepBy:
    """Pause, and take ``steps`` steps; negative numbers step back."""

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
    """Start a new episode of the shown world."""

    random: bool


@dataclasses.dataclass(frozen=True)
class Perturb:
    """Push bodies, move a free body while paused, or move a mocap body at any time.

    The forces act until the next ``Perturb``; zeros end the push.
    """

    forces: np.ndarray
    """(nbody, 6) float64: force (N) and torque (Nm) in world coordinates."""
    qpos: np.ndarray | None = None
    """(nq,) float64; takes effect only while paused."""
    mocap_pos: np.ndarray | None = None
    """(nmocap, 3) float64, metres."""
    mocap_quat: np.ndarray | None = None
    """(nmocap, 4) float64: w, x, y, z."""


@dataclasses.dataclass(frozen=True)
class Drive:
    """Command a walking robot."""

    command: tuple[float, float, float] | None
    """Forward and lateral velocity, m/s, and yaw rate, rad/s; None lets the task draw commands again."""


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
    """Attributes of the ``mujoco.MjvCamera``; None ends the video."""


@dataclasses.dataclass(frozen=True)
class TakePicture:
    """Write a picture of the scene."""

    camera: dict[str, Any]
    """Attributes of the ``mujoco.MjvCamera``."""


@dataclasses.dataclass(frozen=True)
class Close:
    """End the session. Closing a page does not end it, because the page can be opened again."""


Command: TypeAlias = (
    SetMode | SetWorld | SetPaused | SetSpeed | StepBy | Seek | SetBackwards | Reset | SetGhosts | Perturb | Drive
    | SetNumber | SetVideo | TakePicture | Close
)  # fmt: skip


# how the window process starts and reports


@dataclasses.dataclass(frozen=True)
class Opening:
    """The first message to the window process."""

    scene: Scene
    host: str
    """Address that the page is served on."""
    port: int | None
    """Port of the page; None for the first free port from 8080."""


@dataclasses.dataclass(frozen=True)
class Opened:
    """The window is open."""

    address: str
    """The page's address with its token."""
    instructions: tuple[str, ...] = ()
    """Lines to print."""


@dataclasses.dataclass(frozen=True)
class Failed:
    """The window ended with an error."""

    reason: str
    refused: bool = False
    """Whether the host or port was invalid or in use."""


@dataclasses.dataclass(frozen=True)
class Taken:
    """The window is ready for another frame."""


Reply: TypeAlias = Opened | Failed | Taken | Command
