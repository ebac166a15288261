"""Videos of policies, drawn off-screen."""

import importlib.util
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

from lyceum_warp.env import Env
from lyceum_warp.viz import EXTRA
from lyceum_warp.viz._render import CANNOT_DRAW

_MAX_RATE = 60  # frames per second: more than a screen shows would only make the file larger
_POSES = ("qpos", "mocap_pos", "mocap_quat")


class NoVideoError(RuntimeError):
    """Raised where a machine can't draw, or lacks a library for it; the message says which, and the mend."""


@torch.no_grad()
def episode(env: Env, policy: Callable[[torch.Tensor], torch.Tensor], *, seed: int | None = None) -> torch.Tensor:
    """States of one episode under a policy, the first and the last included, (steps + 1, state_space.size).

    Args:
        env: An environment of one world, made with ``autoreset=False`` so that the last state can be seen.
        policy: Called with observations (1, nobs), returns actions (1, nact).
        seed: Seed of the initial state.

    Raises:
        ValueError: The environment has several worlds, resets by itself, or never ends an episode.
    """
    if env.nworld != 1 or env.autoreset:
        raise ValueError("an episode is recorded in one world without automatic resets: make(..., autoreset=False)")
    if env.horizon == 0:
        raise ValueError(f"episodes of {env.task.name!r} never end without a horizon: give make() a horizon")
    env.rand_reset(seed)
    states = [env.get_state()]
    while not env.done.item():
        env.action.copy_(policy(env.obs))
        env.step()
        states.append(env.get_state())
    return torch.cat(states).cpu()


def record(
    env: Env, states: torch.Tensor, out: str | Path, *, size: tuple[int, int] = (640, 480), speed: float = 1.0
) -> Path:
    """Draw states into an mp4 file.

    The camera is the model's own: one that tracks, else one that is fixed to the world; without either a free
    one follows the first body. At most 60 frames a second are drawn, so a short time step leaves out states.

    Args:
        env: The environment that the states belong to.
        states: One world's states, a row each step, (steps, state_space.size).
        out: The file, overwritten.
        size: Width and height in pixels, even numbers.
        speed: Simulated seconds in a second of the video.

    Returns:
        The file's path.

    Raises:
        ValueError: The states don't belong to the environment, or the size is odd.
        NoVideoError: This machine can't draw, or lacks a library for it.
    """
    out = Path(out)
    if states.ndim != 2 or states.shape[1] != env.state_space.size or not len(states):
        raise ValueError(f"states have to be of shape (steps, {env.state_space.size}), not {tuple(states.shape)}")
    if any(pixels < 2 or pixels % 2 for pixels in size):
        raise ValueError(f"a video's width and height have to be even numbers, not {size}")
    check_video()
    rate = speed / env.timestep
    stride = max(1, math.ceil(rate / _MAX_RATE - 1e-9))
    parts = env.state_space.parts
    poses: Any = {name: states[::stride, parts[name]].numpy() for name in _POSES if name in parts}
    with tempfile.TemporaryDirectory() as folder:
        job, model, video = Path(folder, "job.npz"), Path(folder, "model.mjb"), Path(folder, "video.mp4")
        np.savez(job, fps=rate / stride, size=size, **poses)
        mujoco.mj_saveModel(env.model, str(model), None)
        _draw([str(job), str(model), str(video)])
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(video.read_bytes())
    return out


def check_video() -> None:
    """Find out whether the libraries that videos need are installed.

    Raises:
        NoVideoError: They are not.
    """
    if missing := [name for name in ("imageio", "imageio_ffmpeg") if importlib.util.find_spec(name) is None]:
        raise NoVideoError(f"videos need {' and '.join(missing)}: {EXTRA}")


def _libraries() -> list[str]:
    """Values of MUJOCO_GL to try, in order; "" is MuJoCo's own choice."""
    given = os.environ.get("MUJOCO_GL", "")
    others = ["egl", "osmesa"] if sys.platform.startswith("linux") else [""]
    return list(dict.fromkeys([given, *others] if given else others))


def _draw(arguments: list[str]) -> None:
    failures = []
    for library in _libraries():
        environment = {key: value for key, value in os.environ.items() if key not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")}
        if library:
            environment["MUJOCO_GL"] = library
        # -P: the folder of _render.py stays off the path, where its neighbours could hide other packages
        command = [sys.executable, "-P", str(Path(__file__).with_name("_render.py")), *arguments]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        if done.returncode == 0:
            return
        lines = done.stderr.strip().splitlines()
        reason = lines[-1].strip()[:160] if lines else f"it ended with code {done.returncode}"
        failures.append(f"{library or 'OpenGL'}: {reason}")
        if done.returncode > 0 and done.returncode != CANNOT_DRAW:
            raise NoVideoError(f"the video could not be written ({reason})")  # another library would not help
    raise NoVideoError(
        f"this machine can't draw off-screen ({'; '.join(failures)}): install Mesa's EGL (on Debian and Ubuntu "
        "libegl1 and libgl1-mesa-dri) or OSMesa (libosmesa6), or set MUJOCO_GL to a library that works"
    )
