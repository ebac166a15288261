"""What the session, which owns the environments, and the window, which a person looks at, tell each other.

The window runs in a process of its own, so that drawing never holds up a step or a plan. Everything here can be pickled
and is written once by its sender.
"""

import dataclasses
from typing import Literal, TypeAlias

import numpy as np

Mode: TypeAlias = Literal["passive", "controller", "playback"]

WorldChoice: TypeAlias = int | Literal["next", "previous", "best", "worst", "last_ended"]
"""A world by its number, or by its return or its place."""

MOST_GHOSTS = 32
"""The most other worlds, and the most other episodes, that are drawn at once."""
MOST_BURST = 50
"""The most states along a trajectory that are drawn at once."""


# from the session to the window


@dataclasses.dataclass(frozen=True)
class Scene:
    """What stays the same while a window is open."""

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
    """What the poses of all bodies of one world depend on."""

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
    """What the panel says."""

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


# from the window to the session


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
    """Pauses, and moves by some steps; negative ones go back."""

    steps: int


@dataclasses.dataclass(frozen=True)
class Seek:
    """Pauses, and shows one step of the episode that is played back or of the past of the world."""

    step: int


@dataclasses.dataclass(frozen=True)
class SetBackwards:
    """Change the direction of the playback."""

    backwards: bool


@dataclasses.dataclass(frozen=True)
class Reset:
    """Begin a new episode of the world that is shown."""

    random: bool


MAX_GHOSTS = 128
"""Worlds that may be drawn at once beside the one that is shown, and as many episodes."""


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
    """Begins a video, or ends it."""

    on: bool
    camera: Camera | None = None


@dataclasses.dataclass(frozen=True)
class Close:
    """Ends the session. Closing a page is not reported, because it can be opened again."""


Command: TypeAlias = (
    SetMode | SetController | SetWorld | SetEpisode | SetPaused | SetSpeed | StepBy | Seek | SetBackwards | Reset
    | SetGhosts | Perturb | SetVideo | Close
)  # fmt: skip
