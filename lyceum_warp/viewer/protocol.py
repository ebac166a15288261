"""Define the messages between the session process, which owns the worlds, and the window process, which draws them.

Both processes import this module, so it needs NumPy alone. Messages are pickled. Each is written once, by its sender.
"""

import dataclasses
from typing import Literal, TypeAlias

import numpy as np

Graphics: TypeAlias = Literal["web", "native"]

Mode: TypeAlias = Literal["passive", "controller", "playback"]

WorldChoice: TypeAlias = int | Literal["next", "previous", "best", "worst", "last_ended"]
"""A world by its number, or by its return or its place."""

MOST_GHOSTS = 32
"""Maximum number of other worlds, and of other episodes, that are drawn at once."""
MOST_BURST = 50
"""Maximum number of states along a trajectory that are drawn at once."""

TRACE_COLOUR = (0.6, 0.65, 0.75, 0.5)
BEST_COLOUR = (0.1, 0.75, 0.3, 1.0)
"""Colours of a planner's samples and of the best one, in the window and in videos."""

MAX_POINTS, MAX_MESSAGES = 20_000, 200
"""Maximum numbers of curve points and of messages that a frame carries over from earlier frames."""


# from the session to the window


@dataclasses.dataclass(frozen=True)
class Scene:
    """The part of the display that is constant while a window is open."""

    title: str
    """The task's name, or what else is shown."""
    model: bytes
    """The model, as ``mujoco.mj_saveModel`` writes it."""
    nworld: int
    """Worlds to choose from."""
    timestep: float
    """Simulated seconds of a step of the environment."""
    modes: tuple[Mode, ...]
    """Modes to choose from, the first one at the start."""
    controllers: tuple[str, ...]
    """Names of the controllers."""
    episodes: tuple[str, ...]
    """Names of the episodes that can be played back."""
    curves: tuple[str, ...]
    """Names of the live curves: "reward", "eval" and the task's metrics."""


@dataclasses.dataclass(frozen=True)
class Pose:
    """The coordinates that determine the poses of all bodies of one world."""

    qpos: np.ndarray
    """(nq,) float64."""
    mocap_pos: np.ndarray
    """(nmocap, 3) float64."""
    mocap_quat: np.ndarray
    """(nmocap, 4) float64."""


@dataclasses.dataclass(frozen=True)
class Ghost:
    """A pose that is drawn translucently beside the world itself."""

    pose: Pose
    colour: tuple[float, float, float, float]
    """Red, green, blue and opacity, each from 0 to 1."""


@dataclasses.dataclass(frozen=True)
class Status:
    """The contents of the panel."""

    mode: Mode
    controller: str | None
    episode: int | None
    """Index of the episode that is played back."""
    world: int
    step: int
    """Step within the episode."""
    steps: int
    """Steps of the episode that is played back; the horizon otherwise, 0 without one."""
    time: float
    """Simulated seconds of the episode."""
    paused: bool
    speed: float
    """Wanted simulated seconds per second."""
    measured_speed: float
    """Simulated seconds per second, as measured; NaN while paused."""
    plan_ms: float
    """Milliseconds of the last plan or policy call; NaN without one."""
    backwards: bool
    """Whether a playback runs backwards."""
    video: str | None
    """The video that is being taken."""
    seekable: tuple[int, int] = (0, 0)
    """First and last step that can be sought in the past of the world; equal where there are no others."""
    text: tuple[tuple[str, str], ...] = ()
    """Further lines of the panel, a name and a value each."""


@dataclasses.dataclass(frozen=True)
class Frame:
    """One moment of the world that is shown."""

    pose: Pose
    state: np.ndarray
    """The integration state of this world for ``mujoco.mj_setState`` (``mjSTATE_INTEGRATION``), float64."""
    model_fields: dict[str, np.ndarray]
    """Model fields by MuJoCo's names, where this world's values differ from the model's."""
    status: Status
    ghosts: tuple[Ghost, ...] = ()
    traces: np.ndarray | None = None
    """Paths of the planner's samples, (samples, points, 3), metres."""
    best: int | None = None
    """Index of the best of them."""
    samples: np.ndarray | None = None
    """New points of the curves, (points, 1 + curves): simulated seconds, then a value for each curve."""
    messages: tuple[str, ...] = ()
    """New lines: ends of episodes, faults, refused commands."""


def latest(older: Frame | None, newer: Frame) -> Frame:
    """The newer frame, with the curve points and messages of an older one that was not shown."""
    if older is None or (older.samples is None and not older.messages):
        return newer
    samples = [part for part in (older.samples, newer.samples) if part is not None]
    return dataclasses.replace(
        newer,
        samples=np.concatenate(samples)[-MAX_POINTS:] if samples else None,
        messages=(older.messages + newer.messages)[-MAX_MESSAGES:],
    )


# from the window to the session: commands


@dataclasses.dataclass(frozen=True)
class SetMode:
    """Change the mode."""

    mode: Mode


@dataclasses.dataclass(frozen=True)
class SetController:
    """Give control to another controller."""

    name: str


@dataclasses.dataclass(frozen=True)
class SetWorld:
    """Show another world."""

    world: WorldChoice


@dataclasses.dataclass(frozen=True)
class SetEpisode:
    """Play back another episode."""

    episode: int


@dataclasses.dataclass(frozen=True)
class SetPaused:
    """Pause, or go on."""

    paused: bool


@dataclasses.dataclass(frozen=True)
class SetSpeed:
    """Change the speed."""

    speed: float
    """Simulated seconds per second, 1/16 to 16."""


@dataclasses.dataclass(frozen=True)
class StepBy:
    """Pause, and move by some steps; negative ones go back."""

    steps: int


@dataclasses.dataclass(frozen=True)
class Seek:
    """Pause, and show one step of the episode that is played back or of the past of the world."""

    step: int


@dataclasses.dataclass(frozen=True)
class SetBackwards:
    """Change the direction of the playback."""

    backwards: bool


@dataclasses.dataclass(frozen=True)
class Reset:
    """Begin a new episode of the world that is shown."""

    random: bool


@dataclasses.dataclass(frozen=True)
class SetGhosts:
    """Which ghosts are drawn."""

    worlds: tuple[int, ...] = ()
    """Other worlds, at most ``MOST_GHOSTS``."""
    episodes: tuple[int, ...] = ()
    """Other episodes, at the same step, at most ``MOST_GHOSTS``."""
    burst: int = 0
    """Number of states along the trajectory that are drawn at once, at most ``MOST_BURST``."""
    fade: float = 1.0
    """Factor of opacity for each state further away from the present."""
    doppler: bool = False
    """Colour states of the past red, states of the future blue."""
    plan: bool = True
    """The plan's final pose, and the samples' traces."""


@dataclasses.dataclass(frozen=True)
class Perturb:
    """Forces on bodies while running; new positions of a free body while paused; of a mocap body at any time.

    The forces hold until the next command: one with zeros ends a push.
    """

    forces: np.ndarray
    """(nbody, 6) float64: force and torque in world coordinates, N and Nm."""
    qpos: np.ndarray | None = None
    """A new (nq,) float64 while paused."""
    mocap_pos: np.ndarray | None = None
    """New (nmocap, 3) float64, metres."""
    mocap_quat: np.ndarray | None = None
    """New (nmocap, 4) float64: w, x, y, z."""


@dataclasses.dataclass(frozen=True)
class Camera:
    """A free camera, as ``mujoco.MjvCamera`` describes it."""

    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float
    tracked_body: int = -1
    fixed: int = -1
    """Index of a camera of the model instead."""


@dataclasses.dataclass(frozen=True)
class SetVideo:
    """Begin a video, or end it."""

    on: bool
    camera: Camera | None = None


@dataclasses.dataclass(frozen=True)
class Close:
    """End the session. Closing a page is not reported, because it can be opened again."""


Command: TypeAlias = (
    SetMode | SetController | SetWorld | SetEpisode | SetPaused | SetSpeed | StepBy | Seek | SetBackwards | Reset
    | SetGhosts | Perturb | SetVideo | Close
)  # fmt: skip


# how the window process starts and reports


@dataclasses.dataclass(frozen=True)
class Opening:
    """The first message to the window process."""

    scene: Scene
    graphics: Graphics
    host: str
    """Address on which the page is served."""
    port: int | None
    """Port of the page; None for the first free one from 8080 on."""
    browser: bool
    """Whether to open the page in this machine's browser."""


@dataclasses.dataclass(frozen=True)
class Opened:
    """The window runs."""

    address: str = ""
    """The page's address with its token; empty without a page."""
    instructions: tuple[str, ...] = ()
    """Lines to print."""


@dataclasses.dataclass(frozen=True)
class Failed:
    """The window ends because of an error."""

    reason: str
    refused: bool = False
    """Whether the caller's address or port is the reason."""


@dataclasses.dataclass(frozen=True)
class Taken:
    """The window is ready for another frame."""


Reply: TypeAlias = Opened | Failed | Taken | Command
