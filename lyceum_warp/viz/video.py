"""Write videos of states, rendered off-screen in a subprocess."""

import contextlib
import math
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TypeAlias

import mujoco
import torch

from lyceum_warp.env import Env
from lyceum_warp.support.long_work import LongWork
from lyceum_warp.support.validate import positive_number
from lyceum_warp.viz.cameras import CameraChoice, camera_values
from lyceum_warp.viz.extra import NoVideoError
from lyceum_warp.viz.ghosts import REFERENCE, reference_states
from lyceum_warp.viz.render import Shot
from lyceum_warp.viz.renderer import Renderer, check_video

__all__ = ["NoVideoError", "Progress", "Recorder", "check_video", "write_video"]

Progress: TypeAlias = Callable[[int, int], object]
"""A progress callback, called with two numbers: units done so far, and units in total."""

_MAX_RATE = 60  # maximum frames per second, the rate of most screens
_KILLED = 5.0  # maximum seconds until the thread ends after its subprocess was killed


def write_video(
    env: Env,
    states: torch.Tensor,
    out: str | Path,
    *,
    camera: CameraChoice = None,
    size: tuple[int, int] = (640, 480),
    speed: float = 1.0,
    progress: Progress | None = None,
) -> Path:
    """Render states into an mp4 file, with the model fields of their worlds.

    The video has at most 60 frames per second. If time steps are shorter than frames, states are skipped. A subprocess
    renders the video, without a display.

    Args:
        env: The environment of the states.
        states: The states of one world, one row per step, (steps, state_space.size).
        out: The file. An existing file is replaced when the video is complete.
        camera: A camera of the model by its name or index, a ``FreeCamera`` or ``mujoco.MjvCamera``, or "free" for
            MuJoCo's default free camera. The default is the model's first tracking camera. If the model has no
            tracking camera, the default is its first camera that is fixed to the world. If it has no such camera
            either, a new camera follows the first body.
        size: The width and the height in pixels, both even.
        speed: The simulated seconds per second of the video.
        progress: A function that is called after each frame with the number of frames so far and the total number. The
            default prints a progress bar to stderr, or lines if stderr is not a terminal.

    Raises:
        ValueError: The states do not have the environment's shape, the model has no such camera, the size is odd, or
            the file's name does not end in ``.mp4``.
        NoVideoError: This machine cannot render, or a package for videos is missing.
    """
    check_states(env, states)
    rate = positive_number("speed", speed, "simulated seconds per second") / env.timestep
    stride = max(1, math.ceil(rate / _MAX_RATE - 1e-9))
    rows = states[::stride].cpu()
    view = camera_values(env.model, camera)
    with (
        Renderer(env.model, out, camera=view, size=size, fps=rate / stride) as renderer,
        LongWork("rendering the video", "frames") if progress is None else contextlib.nullcontext(progress) as report,
    ):
        for i, shot in enumerate(shots(env, rows)):
            renderer.render(shot)
            report(i + 1, len(rows))
        return renderer.finish()


def check_states(env: Env, states: torch.Tensor) -> None:
    """Check the shape of states of one world."""
    if states.ndim != 2 or states.shape[1] != env.state_space.size or not len(states):
        raise ValueError(f"states must have the shape (steps, {env.state_space.size}), not {tuple(states.shape)}")


def shots(env: Env, states: torch.Tensor) -> Iterator[Shot]:
    """Yield the content of a frame for each state."""
    parts = env.state_space.parts
    for state in states.numpy():
        fields = {field.name: state[parts[field.name]] for field in env.task.dynamics if field.in_model}
        ghosts: Any = [(pose, REFERENCE, (0.0, 0.0)) for pose in reference_states(env, state)]
        yield Shot(state=state[: env.engine.integration_size], model_fields=fields, ghosts=ghosts, lines=[], frames=1)


class Recorder:
    """Renders a video from shots that arrive one by one, or a picture from a single shot.

    A ``Shot`` is the content of one or several frames. Shots wait in a queue for a low-priority subprocess, which
    renders them. If the queue is full, further shots are dropped, and the last shot in the queue is displayed longer.
    The file is written when the video is complete.

    Args:
        model: The model.
        out: The file: an mp4, or a png if ``fps`` is None.
        camera: The attributes of the ``mujoco.MjvCamera``.
        size: The width and the height in pixels, both even.
        fps: The frames per second of the video, or None for a picture.
        most_waiting: The maximum number of shots in the queue.
    """

    def __init__(
        self, model: mujoco.MjModel, out: Path, *, camera: dict[str, Any], size: tuple[int, int] = (640, 480),
        fps: float | None, most_waiting: int,
    ) -> None:  # fmt: skip
        self.out = out
        self.added = 0
        """The number of frames so far, including dropped ones."""
        self.dropped = 0
        """The number of frames that repeat an earlier picture, because the queue was full."""
        self._renderer = Renderer(model, out, camera=camera, size=size, fps=fps, background=True)
        self._most = most_waiting
        self._shots: SimpleQueue[Shot | None] = SimpleQueue()
        self._newest: Shot
        self._error: NoVideoError | OSError | None = None
        # Thread.join of Python 3.11 would mark the thread as stopped if a signal interrupts the call
        self._done = threading.Event()
        threading.Thread(target=self._run, name="lyceum-warp video", daemon=True).start()

    @property
    def finished(self) -> bool:
        """Whether the work on the video has ended. After a failure, ``close`` raises the error."""
        return self._done.is_set()

    def add(self, shot: Shot) -> None:
        """Add a shot, unless the video has failed."""
        self.added += shot["frames"]
        if self._shots.qsize() < self._most:
            self._newest = shot
            self._shots.put(shot)
        else:
            self._newest["frames"] += shot["frames"]
            self.dropped += shot["frames"]

    def end(self) -> None:
        """Announce that no more shots follow. The subprocess then completes the file."""
        self._shots.put(None)

    def wait(self, seconds: float) -> None:
        """Wait until the video is complete or has failed, but at most for the given seconds."""
        self._done.wait(seconds)

    def close(self) -> Path:
        """Call ``end``, wait until the file is complete, and return its path."""
        self.end()
        self._done.wait()
        if self._error is not None:
            raise self._error
        return self.out

    def cancel(self) -> None:
        """Cancel the video, and write no file. A complete video is kept."""
        if not self.finished:
            self.end()
            self._renderer.abandon()
            self._done.wait(_KILLED)

    def _run(self) -> None:
        product = self._renderer.product
        try:
            with self._renderer as renderer:
                while (shot := self._shots.get()) is not None:
                    renderer.render(shot)
                renderer.finish()
        except (NoVideoError, OSError) as error:
            self._error = NoVideoError(f"{product} {self.out} was cancelled") if self._renderer.abandoned else error
        except Exception as error:  # a thread has no caller that could catch the error
            self._error = NoVideoError(f"{product} could not be written ({' '.join(str(error).split())})")
        finally:
            self._done.set()
