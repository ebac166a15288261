"""Carry out the commands of the window."""

import numpy as np
import torch

from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.session.stage import Stage


def obey(stage: Stage, command: protocol.Command) -> None:
    """Carry out a command.

    Raises:
        ValueError: The command names an unknown world, or perturbs a playback.
        NoVideoError: A video cannot be made.
        ControllerError: A controller raised an exception.
    """
    match command:
        case protocol.SetMode():
            _set_mode(stage, command)
        case protocol.SetWorld(choice):
            world = stage.main.choose(choice)
            if not 0 <= world < stage.env.nworld:
                raise ValueError(f"there is no world {world}: there are {stage.env.nworld} worlds, numbered from 0")
            stage.show_world(world)
        case protocol.SetPaused(paused):
            stage.paused = paused
            stage.progress.clear()
        case protocol.SetSpeed(speed):
            stage.speed = speed
            stage.progress.clear()
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
            if stage.mode == "playback":
                stage.seek_episode(step)
            elif (delta := step - int(stage.live.env.episode_step[stage.live.world])) < 0:
                stage.back(-delta)
            else:
                stage.live.forward(delta)
        case protocol.SetBackwards(backwards):
            stage.playback.backwards = backwards
        case protocol.Reset(random):
            if stage.mode == "playback":
                stage.seek_episode(stage.playback.episode.steps if stage.playback.backwards else 0)
            else:
                stage.reset(random=random)
        case protocol.SetGhosts():
            stage.frames.ghosts = command
        case protocol.Perturb():
            _perturb(stage, command)
        case protocol.Drive(velocity):
            if stage.driving.limits is None or stage.mode == "playback":
                raise ValueError(
                    "the robot cannot be driven: this needs a velocity task, and a mode other than playback"
                )
            stage.driving.wanted = velocity
            stage.driving.apply(stage.live)
        case protocol.SetNumber(of, name, value):
            stage.set_number(of, name, value)
        case protocol.TakePicture(camera):
            stage.videos.picture(camera, stage.shown or stage.frame())
        case protocol.SetVideo(camera):
            stage.videos.end() if camera is None else stage.videos.begin(camera)


def _set_mode(stage: Stage, command: protocol.SetMode) -> None:
    """Change the mode, the controller or the episode. After a playback, continue the world from its displayed state."""
    mode, controller = command.mode, command.controller
    if command.episode is not None:
        stage.playback.choose(command.episode)
    if mode == stage.mode and controller is None:
        return
    state = stage.playback.state if stage.mode == "playback" else None
    stage.select(mode, controller or stage.controller or next(iter(stage.controllers), None))
    if state is not None:
        stage.go_on_from(torch.from_numpy(state), stage.live, new_episode=True)


def _perturb(stage: Stage, command: protocol.Perturb) -> None:
    given = {"mocap_pos": command.mocap_pos, "mocap_quat": command.mocap_quat}
    given["qpos"] = command.qpos if stage.paused else None
    parts = {name: value for name, value in given.items() if value is not None}
    push = bool(np.any(command.forces))
    if stage.mode == "playback":
        if push or parts:
            raise ValueError("a playback cannot be perturbed: select another mode")
        return
    stage.dragging = push
    if parts:
        stage.live.write(**parts)
    if push:
        stage.live.push(command.forces)
    elif stage.live.pushed == stage.live.world:
        stage.live.end_push()
