"""Carry out the commands of the window."""

import numpy as np
import torch

from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.session.stage import Stage, check_world

SLOWEST, FASTEST = 1 / 16, 16.0
"""Bounds of the speed, simulated seconds per second."""


def obey(stage: Stage, command: protocol.Command) -> None:
    """Carry out a command.

    Raises:
        ValueError: It cannot be carried out; the message is for the person.
        NoVideoError: A video cannot be taken.
        ControllerError: A controller raised an exception.
    """
    match command:
        case protocol.SetMode(mode):
            _set_mode(stage, mode)
        case protocol.SetController(name):
            if name not in stage.controllers:
                known = ", ".join(stage.controllers) or "none"
                raise ValueError(f"there is no controller {name!r}: there are {known}")
            _set_mode(stage, "controller", name)
        case protocol.SetWorld(world):
            _set_world(stage, world)
        case protocol.SetEpisode(episode):
            stage.playback.choose(episode)
            _set_mode(stage, "playback")
        case protocol.SetPaused(paused):
            stage.paused = paused
            stage.restart_measurement()
        case protocol.SetSpeed(speed):
            stage.speed = min(max(float(speed), SLOWEST), FASTEST)
            stage.restart_measurement()
        case protocol.StepBy(steps):
            stage.paused = True
            if stage.mode == "playback":
                stage.seek_episode(stage.playback.step + steps)
            elif steps >= 0:
                stage.advance(steps)
            else:
                stage.back(-steps)
        case protocol.Seek(step):
            stage.paused = True
            _seek(stage, step)
        case protocol.SetBackwards(backwards):
            stage.playback.backwards = backwards
        case protocol.Reset(random):
            if stage.mode == "playback":
                stage.seek_episode(stage.playback.episode.steps if stage.playback.backwards else 0)
            else:
                stage.reset(random=random)
        case protocol.SetGhosts():
            _set_ghosts(stage, command)
        case protocol.Perturb():
            _perturb(stage, command)
        case protocol.SetVideo(on, camera):
            stage.videos.begin(camera) if on else stage.videos.end()


def _set_mode(stage: Stage, mode: protocol.Mode, controller: str | None = None) -> None:
    """Change the mode, or the controller.

    From a playback, the worlds go on from the state that is shown.
    """
    if mode not in stage.scene.modes:
        raise ValueError(f"there is no mode {mode!r} here: there are {', '.join(stage.scene.modes)}")
    if mode == stage.mode and controller is None:
        return
    state = stage.playback.state if stage.mode == "playback" else None
    stage.select(mode, controller or stage.controller or next(iter(stage.controllers), None))
    if state is not None:
        stage.go_on_from(torch.from_numpy(state), stage.live, new_episode=True)


def _set_world(stage: Stage, choice: protocol.WorldChoice) -> None:
    world = stage.main.choose(choice)
    if world is None and choice == "last_ended":
        raise ValueError("no episode has ended yet")
    stage.show_world(check_world(choice if world is None else world, stage.env.nworld))


def _seek(stage: Stage, step: int) -> None:
    """Show a step of the episode that is played back, or of the past of the world, as far as it is kept."""
    if stage.mode == "playback":
        return stage.seek_episode(step)
    live = stage.live
    delta = step - int(live.env.episode_step[live.world])
    if delta < 0:
        stage.back(-delta)
    for _ in range(min(delta, live.past.ahead)):
        live.step(stage.act)


def _perturb(stage: Stage, command: protocol.Perturb) -> None:
    """Push bodies of the shown world, or place them while paused."""
    given = {"mocap_pos": command.mocap_pos, "mocap_quat": command.mocap_quat}
    given["qpos"] = command.qpos if stage.paused else None
    parts = {name: value for name, value in given.items() if value is not None}
    push = bool(np.any(command.forces))
    if stage.mode == "playback":
        if push or parts:
            raise ValueError("a playback cannot be perturbed: change the mode")
        return
    stage.dragging = push
    if parts:
        stage.live.write(**parts)
    if push:
        stage.live.push(command.forces)
    elif stage.live.pushed == stage.live.world:
        stage.live.end_push()


def _set_ghosts(stage: Stage, ghosts: protocol.SetGhosts) -> None:
    for kind, count, most in (
        ("worlds", len(ghosts.worlds), protocol.MOST_GHOSTS), ("episodes", len(ghosts.episodes), protocol.MOST_GHOSTS),
        ("states of the burst", ghosts.burst, protocol.MOST_BURST),
    ):  # fmt: skip
        if count > most:
            raise ValueError(f"at most {most} {kind} are drawn as ghosts, not {count}: choose fewer")
    for world in ghosts.worlds:
        check_world(world, stage.env.nworld)
    episodes = len(stage.playback.episodes)
    if any(not 0 <= episode < episodes for episode in ghosts.episodes):
        raise ValueError(f"there are {episodes} episodes, from 0: not {ghosts.episodes}")
    stage.frames.ghosts = ghosts
