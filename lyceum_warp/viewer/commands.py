"""Define the commands of the window. Each command is a function of the session's stage.

The window sends a ``Command``, which names the function and its arguments, and the session calls it. This module
imports only NumPy, because the window process never loads torch or Warp. ``window/actions.py`` lists the keys.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Concatenate, Literal, NamedTuple, ParamSpec, TypeAlias

import numpy as np

from lyceum_warp.viewer.protocol import Ghosts, Mode, Owner, Velocity

if TYPE_CHECKING:
    from lyceum_warp.viewer.session.stage import Stage

P = ParamSpec("P")

WorldChoice: TypeAlias = int | Literal["next", "previous", "best", "worst"]
"""The number of a world, or a rule that selects one. "best" and "worst" compare the returns of unfinished episodes."""


class Command(NamedTuple):
    """A call of a function of this module, without its first argument."""

    function: Callable[..., None]
    arguments: tuple[Any, ...]
    options: dict[str, Any]


def command(function: Callable[Concatenate[Stage, P], None], *arguments: P.args, **options: P.kwargs) -> Command:
    """Return a command, such as ``command(step_by, 1)``."""
    return Command(function, arguments, options)


def set_mode(stage: Stage, mode: Mode, controller: str | None = None, episode: int | None = None) -> None:
    """Change the mode, the controller or the episode. After a playback, continue the world from its displayed state."""
    if episode is not None:
        stage.playback.choose(episode)
    if mode == stage.mode and controller is None:
        return
    state = stage.playback.state if stage.mode == "playback" else None
    stage.select(mode, controller or stage.controller or next(iter(stage.controllers), None))
    if state is not None:
        stage.go_on_from(state, stage.live, new_episode=True)


def set_world(stage: Stage, choice: WorldChoice) -> None:
    """Show another world."""
    world = stage.main.choose(choice)
    if not 0 <= world < stage.env.nworld:
        raise ValueError(f"there is no world {world}: there are {stage.env.nworld} worlds, numbered from 0")
    stage.show_world(world)


def set_paused(stage: Stage, paused: bool) -> None:
    """Pause, or continue."""
    stage.paused = paused
    stage.progress.clear()


def set_speed(stage: Stage, speed: float) -> None:
    """Change the speed: simulated seconds per second of wall time, from 1/16 to 16."""
    stage.speed = speed
    stage.progress.clear()


def step_by(stage: Stage, steps: int) -> None:
    """Pause, and make steps. A negative number steps back."""
    stage.paused = True
    if stage.mode == "playback":
        stage.seek_episode(stage.playback.step + steps)
    elif steps >= 0:
        stage.advance(steps)
    else:
        stage.back(-steps)


def seek(stage: Stage, step: int) -> None:
    """Pause, and show a step of the playback or of the world's history."""
    stage.paused = True
    if stage.mode == "playback":
        stage.seek_episode(step)
    elif (steps := step - int(stage.live.env.episode_step[stage.live.world])) < 0:
        stage.back(-steps)
    else:
        stage.live.forward(steps)


def show_clip(stage: Stage, start: int, clip: int, frame: int) -> None:
    """Put the displayed world into a frame of a clip. Later episodes begin in the clip ``start``, or in any if -1."""
    first = stage.env.task.params["start_frame"]
    stage.live.env.set_params(start_clip=clip, start_frame=frame)
    stage.reset(random=False)
    for env in {stage.env, stage.live.env}:
        env.set_params(start_clip=start, start_frame=first)


def set_backwards(stage: Stage, backwards: bool) -> None:
    """Set the direction of the playback."""
    stage.playback.backwards = backwards


def reset(stage: Stage, random: bool) -> None:
    """Start a new episode of the displayed world, or the playback from its beginning."""
    if stage.mode == "playback":
        stage.seek_episode(stage.playback.episode.steps if stage.playback.backwards else 0)
    else:
        stage.reset(random=random)


def set_ghosts(stage: Stage, ghosts: Ghosts) -> None:
    """Choose the ghosts to show."""
    stage.frames.ghosts = ghosts


def perturb(
    stage: Stage,
    pull: dict[str, Any],
    qpos: np.ndarray | None = None,
    mocap_pos: np.ndarray | None = None,
    mocap_quat: np.ndarray | None = None,
) -> None:
    """Pull a body, move bodies while paused, or move mocap bodies at any time.

    Args:
        stage: The stage.
        pull: A spring between the mouse and a body, as attributes of a ``mujoco.MjvPerturb``, or an empty dict. It acts
            until the next call.
        qpos: New positions, (nq,) float64, which are ignored unless the session is paused.
        mocap_pos: New positions of mocap bodies, (nmocap, 3) float64, in metres.
        mocap_quat: New orientations of mocap bodies, (nmocap, 4) float64: w, x, y, z.
    """
    parts = {"qpos": qpos if stage.paused else None, "mocap_pos": mocap_pos, "mocap_quat": mocap_quat}
    values = {name: value for name, value in parts.items() if value is not None}
    if stage.mode == "playback":
        if pull or values:
            raise ValueError("a playback cannot be perturbed: select another mode")
        return
    if values:
        stage.live.write(**values)
    stage.live.pull = pull


def drive(stage: Stage, velocity: Velocity | None) -> None:
    """Command a walking robot. Without a velocity, the task chooses its commands again."""
    if stage.driving.limits is None or stage.mode == "playback":
        raise ValueError("the robot cannot be driven: this needs a velocity task, and a mode other than playback")
    stage.driving.velocity = velocity
    stage.driving.apply(stage.live)


def set_number(stage: Stage, owner: Owner, name: str, value: float) -> None:
    """Change a setting of the planner in use, a parameter of the task, or a model field of the displayed world."""
    stage.set_number(owner, name, value)


def set_watched(stage: Stage, watched: bool) -> None:
    """Stop all worlds while no page is visible. A video in progress goes on."""
    stage.watched = watched
    stage.progress.clear()


def set_video(stage: Stage, camera: dict[str, Any] | None) -> None:
    """Start a video from a camera (attributes of the ``mujoco.MjvCamera``), or end the video."""
    stage.videos.end() if camera is None else stage.videos.begin(camera)


def set_pictures(stage: Stage, shown: bool) -> None:
    """Show or hide the pictures that a policy sees."""
    stage.pictures.shown = shown


def take_picture(stage: Stage, camera: dict[str, Any]) -> None:
    """Write a picture of the scene."""
    stage.videos.picture(camera, stage.frame(news=False))


def close(stage: Stage) -> None:
    """End the session. Closing the page does not end the session, because the page can be opened again."""
    stage.closed = True


BETWEEN_CALLS = {set_mode, set_number}
"""Commands that wait until no controller is being called."""
