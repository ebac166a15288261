"""Videos of policies, drawn off-screen."""

import importlib.util
import math
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import mujoco
import numpy as np
import torch

from lyceum_warp.env import Env
from lyceum_warp.viz import EXTRA
from lyceum_warp.viz.render import CANNOT_DRAW, MODEL_FIELD

Progress: TypeAlias = Callable[[int, int], object]
"""Called with how much is done, and how much there is in all."""

_MAX_RATE = 60  # frames per second; screens rarely show more
_POSES = ("qpos", "mocap_pos", "mocap_quat")


class NoVideoError(RuntimeError):
    """The machine cannot draw, or lacks a package for videos. The message names it and the fix."""


@torch.no_grad()
def episode(
    env: Env,
    policy: Callable[[torch.Tensor], torch.Tensor],
    *,
    seed: int | None = None,
    progress: Progress | None = None,
) -> torch.Tensor:
    """Run one episode under a policy, and return all its states, (steps + 1, state_space.size), on the CPU.

    Args:
        env: An environment of one world, made with ``autoreset=False`` so that the last state is kept.
        policy: Called with observations, (1, nobs); returns actions, (1, nact).
        seed: Seed of the initial state.
        progress: Called now and then with the number of steps so far and the horizon.

    Raises:
        ValueError: The environment has several worlds or automatic resets, or its episodes may never end.
    """
    if env.nworld != 1 or env.autoreset:
        raise ValueError(
            "a video shows one world without automatic resets, not "
            f"nworld={env.nworld}, autoreset={env.autoreset}: make(..., autoreset=False)"
        )
    if env.horizon == 0:
        raise ValueError(f"episodes of {env.task.name!r} may never end without a horizon: make(..., horizon=1000)")
    env.rand_reset(seed)
    states = [env.get_state()]
    while not env.done.item():
        env.action.copy_(policy(env.obs))
        env.step()
        states.append(env.get_state())
        if progress is not None and len(states) % 10 == 0:
            progress(len(states), env.horizon)
    return torch.cat(states).cpu()


def write_video(
    env: Env,
    states: torch.Tensor,
    out: str | Path,
    *,
    size: tuple[int, int] = (640, 480),
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Draw states into an mp4 file, each with the model fields that belong to it.

    The camera is the model's first tracking camera, else its first camera that is fixed to the world, else a camera
    that follows the first body. The video has at most 60 frames per second: with a shorter time step, states are left
    out.

    Args:
        env: Environment that the states come from.
        states: States of one world, one row per step, (steps, state_space.size).
        out: The file. It is overwritten.
        size: Width and height in pixels, even numbers.
        speed: Simulated seconds per second of the video.
        progress: Called after each frame with the number of frames so far and in all.

    Returns:
        The file's path.

    Raises:
        ValueError: The states do not have the environment's shape, or the size is odd.
        NoVideoError: The machine cannot draw, or lacks a package for videos.
    """
    out = Path(out)
    if states.ndim != 2 or states.shape[1] != env.state_space.size or not len(states):
        raise ValueError(f"states must have the shape (steps, {env.state_space.size}), not {tuple(states.shape)}")
    if any(pixels < 2 or pixels % 2 for pixels in size):
        raise ValueError(f"size must be two even numbers, the width and the height in pixels, not {size}")
    check_video()
    rate = speed / env.timestep
    stride = max(1, math.ceil(rate / _MAX_RATE - 1e-9))
    parts = env.state_space.parts
    keys = {name: name for name in _POSES if name in parts}
    keys |= {MODEL_FIELD + field.name: field.name for field in env.task.dynamics}
    rows: Any = {key: states[::stride, parts[name]].numpy() for key, name in keys.items()}
    with tempfile.TemporaryDirectory() as folder:
        job, model, video = Path(folder, "job.npz"), Path(folder, "model.mjb"), Path(folder, "video.mp4")
        np.savez(job, fps=rate / stride, size=size, **rows)
        mujoco.mj_saveModel(env.model, str(model), None)
        _draw([str(job), str(model), str(video)], progress)
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(video.read_bytes())
    return out


def check_video() -> None:
    """Check that the packages for videos are installed.

    Raises:
        NoVideoError: One of them is not installed.
    """
    if missing := [name for name in ("imageio", "imageio_ffmpeg") if importlib.util.find_spec(name) is None]:
        raise NoVideoError(f"videos need {' and '.join(missing)}: {EXTRA}")


def _libraries() -> list[str]:
    """Values of MUJOCO_GL to try, in order; "" is MuJoCo's default."""
    given = os.environ.get("MUJOCO_GL", "")
    others = ["egl", "osmesa"] if sys.platform.startswith("linux") else [""]
    return list(dict.fromkeys([given, *others] if given else others))


def _draw(arguments: list[str], progress: Progress | None = None) -> None:
    """Run ``render.py`` with each graphics library until one works."""
    failures = []
    for library in _libraries():
        environment = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
        if library:
            environment["MUJOCO_GL"] = library
        # -P keeps the folder of render.py off the path, where its other modules could shadow packages
        command = [sys.executable, "-P", str(Path(__file__).with_name("render.py")), *arguments]
        code, errors = _run(command, environment, progress)
        if code == 0:
            return
        lines = errors.strip().splitlines()
        reason = lines[-1].strip()[:160] if lines else f"it ended with code {code}"
        failures.append(f"{library or 'OpenGL'}: {reason}")
        if code > 0 and code != CANNOT_DRAW:  # another graphics library would fail, too
            raise NoVideoError(f"the video could not be written ({reason})")
    raise NoVideoError(
        f"this machine cannot draw off-screen ({'; '.join(failures)}): install Mesa's EGL (on Debian and Ubuntu "
        "libegl1 and libgl1-mesa-dri) or OSMesa (libosmesa6), or set MUJOCO_GL to a library that works"
    )


def _run(command: list[str], environment: dict[str, str], progress: Progress | None) -> tuple[int, str]:
    """Run ``render.py``, which prints a line for each frame; returns its exit code and its errors."""
    with (
        tempfile.TemporaryFile("w+", errors="replace") as errors,
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=errors, text=True) as process,
    ):
        try:
            for line in process.stdout or ():
                if progress is not None and (frame := re.fullmatch(r"frame (\d+) of (\d+)\n", line)):
                    progress(int(frame[1]), int(frame[2]))
        except BaseException:  # Ctrl-C
            process.kill()
            raise
        code = process.wait()
        errors.seek(0)
        return code, errors.read()
