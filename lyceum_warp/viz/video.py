"""Write videos of states, rendered off-screen in a subprocess."""

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import mujoco
import numpy as np
import torch
from numpy.typing import ArrayLike

from lyceum_warp.algos.policy import Policy, acting
from lyceum_warp.env import Env
from lyceum_warp.support.validate import positive_number, whole_number
from lyceum_warp.viz import NoVideoError
from lyceum_warp.viz.cameras import CameraChoice, camera_values, find_camera
from lyceum_warp.viz.drawing import Drawing, check_video
from lyceum_warp.viz.long_work import LongWork
from lyceum_warp.viz.render import Shot

__all__ = ["GhostPose", "Line", "NoVideoError", "Progress", "Recorder", "check_video", "episode", "write_video"]

Progress: TypeAlias = Callable[[int, int], object]
"""Called with the number of units done, and their total number."""

GhostPose: TypeAlias = tuple[ArrayLike, ArrayLike | None, ArrayLike | None, ArrayLike]
"""qpos, mocap_pos, mocap_quat and colour of a ghost."""

Line: TypeAlias = tuple[ArrayLike, ArrayLike]
"""Points of a line, (n, 3), and its colour."""

_LINE_WIDTH = 2.0  # pixels
_MAX_RATE = 60  # frames per second; screens rarely show more
_POSES = ("qpos", "mocap_pos", "mocap_quat")
_KILLED = 5.0  # seconds to wait for the thread after its process was killed


@torch.no_grad()
def episode(
    env: Env,
    policy: Policy,
    *,
    seed: int | None = None,
    progress: Progress | None = None,
) -> torch.Tensor:
    """Run one episode under a policy, and return all its states, (steps + 1, state_space.size), on the CPU.

    Args:
        env: An environment of one world, made with ``autoreset=False``.
        policy: Maps observations, (1, nobs), to actions, (1, nact), by ``act`` or when it is called.
        seed: Seed of the initial state.
        progress: Called regularly with the number of steps so far and the horizon.

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
    act, states = acting(policy), [env.get_state()]
    while not env.done.item():
        env.action.copy_(act(env.obs))
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
    camera: CameraChoice = None,
    size: tuple[int, int] = (640, 480),
    speed: float = 1.0,
    progress: Progress | bool = True,
) -> Path:
    """Render states into an mp4 file, each with its own model fields.

    The video has at most 60 frames per second; with a shorter time step, states are skipped. A subprocess draws it,
    without a display.

    Args:
        env: Environment of the states.
        states: States of one world, one row per step, (steps, state_space.size).
        out: The file. It is replaced when the video is complete.
        camera: A camera of the model by its name or index, a ``FreeCamera`` or ``mujoco.MjvCamera``, or "free" for
            MuJoCo's default free camera. By default the model's first tracking camera, else its first camera fixed to
            the world, else a camera that follows the first body.
        size: Width and height in pixels, even numbers.
        speed: Simulated seconds per second of the video.
        progress: Called after each frame with the number of frames so far and in all. True shows a bar on a terminal,
            otherwise lines on stderr; False shows nothing.

    Returns:
        The file's path.

    Raises:
        ValueError: The states do not have the environment's shape, the model has no such camera, the size is odd, or
            the file's name does not end in ``.mp4``.
        NoVideoError: This machine cannot render, or a package for videos is missing.
    """
    if states.ndim != 2 or states.shape[1] != env.state_space.size or not len(states):
        raise ValueError(f"states must have the shape (steps, {env.state_space.size}), not {tuple(states.shape)}")
    rate = positive_number("speed", speed, "simulated seconds per second") / env.timestep
    stride = max(1, math.ceil(rate / _MAX_RATE - 1e-9))
    rows = states[::stride].cpu()
    with (
        Drawing(env.model, out, camera=camera, size=size, fps=rate / stride) as drawing,
        _shown_progress(progress) as report,
    ):
        for i, shot in enumerate(shots(env, rows)):
            drawing.draw(shot)
            if report is not None:
                report(i + 1, len(rows))
        return drawing.finish()


def shots(env: Env, states: torch.Tensor) -> Iterator[Shot]:
    """Yield a shot of each state, with its own model fields.

    Args:
        env: Environment of the states.
        states: The states, (number of states, state_space.size), on the CPU.
    """
    parts = env.state_space.parts
    poses = [states[:, parts.get(name, slice(0))].numpy() for name in _POSES]
    fields = {field.name: states[:, parts[field.name]].numpy() for field in env.task.dynamics}
    for i in range(len(states)):
        yield Shot(
            pose=(poses[0][i], poses[1][i].reshape(-1, 3), poses[2][i].reshape(-1, 4)),
            model_fields={name: values[i] for name, values in fields.items()},
            camera=None, ghosts=[], lines=[], frames=1,
        )  # fmt: skip


def _shown_progress(progress: Progress | bool) -> contextlib.AbstractContextManager[Progress | None]:
    if progress is True:
        return LongWork("drawing the video", "frames")
    return contextlib.nullcontext(progress or None)


class Recorder:
    """A video of poses that are added one by one, for example by a viewer.

    A subprocess draws them at a low priority, and ``add`` never waits for it. Poses wait in a queue, and ``close``
    waits until the last one is drawn. ``most_waiting`` limits the queue: if it is full, new poses are dropped, and
    the last pose in the queue is shown longer, so that the video keeps its duration. The file is written when the video
    is complete. After ``cancel``, after an error within a ``with`` block, or if the program is killed, an older file of
    this name is unchanged.

    >>> with Recorder(env.model, "video.mp4", camera="side", fps=1 / env.timestep) as mp4:
    ...     for _ in range(100):
    ...         env.step()
    ...         mp4.add(env.field("qpos")[0])

    Args:
        model: The model of the poses.
        out: The file, whose name ends in ``.mp4``.
        camera: The camera, as in ``write_video``.
        size: Width and height in pixels, even numbers.
        fps: Frames per second of the video.
        most_waiting: Maximum number of poses in the queue; unlimited by default.

    Raises:
        ValueError: The model has no such camera, or an argument is out of range.
        NoVideoError: A package for videos is not installed.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        out: str | Path,
        *,
        camera: CameraChoice = None,
        size: tuple[int, int] = (640, 480),
        fps: float = 30.0,
        most_waiting: int | None = None,
    ) -> None:
        self.model, self.out = model, Path(out)
        bodies = np.argsort(model.body_mocapid)[model.nbody - model.nmocap :]  # in the order of their mocap poses
        self._mocap = model.body_pos[bodies].copy(), model.body_quat[bodies].copy()
        self._drawing = Drawing(model, out, camera=camera, size=size, fps=fps, background=True)
        self._most = math.inf if most_waiting is None else whole_number("most_waiting", most_waiting, low=1)
        self._poses: deque[Shot] = deque()
        self._changed = threading.Condition()  # also guards the poses and the counts
        self._added = self._drawn = self._dropped = 0
        self._ended = self._cancelled = False
        self._error: NoVideoError | OSError | None = None
        self._thread = threading.Thread(target=self._draw, name="lyceum-warp video", daemon=True)
        self._thread.start()

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(self, kind: object, *exception: object) -> None:
        if kind is None:
            self.close()
        else:
            self.cancel()

    @property
    def added(self) -> int:
        """Number of frames so far."""
        return self._added

    @property
    def drawn(self) -> int:
        """Number of rendered frames."""
        return self._drawn

    @property
    def dropped(self) -> int:
        """Number of frames whose poses were dropped, by a full queue or by ``end``."""
        return self._dropped

    @property
    def finished(self) -> bool:
        """Whether rendering has ended, with a complete file or with an error that ``close`` raises."""
        return not self._thread.is_alive()

    def add(
        self,
        qpos: ArrayLike,
        mocap_pos: ArrayLike | None = None,
        mocap_quat: ArrayLike | None = None,
        *,
        model_fields: Mapping[str, ArrayLike] | None = None,
        camera: CameraChoice = None,
        ghosts: Iterable[GhostPose] = (),
        lines: Iterable[Line] = (),
        frames: int = 1,
    ) -> None:
        """Add a copy of a pose.

        Args:
            qpos: Positions, (nq,).
            mocap_pos: Positions of the mocap bodies, (nmocap, 3) metres; by default the model's.
            mocap_quat: Orientations of the mocap bodies, (nmocap, 4), w, x, y, z; by default the model's.
            model_fields: Model fields by MuJoCo's names, if they differ from the model's in this pose.
            camera: The camera from this pose on.
            ghosts: Additional poses to draw: (qpos, mocap_pos, mocap_quat, colour). mocap_pos and mocap_quat may be
                None; the colour is red, green, blue and opacity, from 0 to 1.
            lines: Lines through points: (points, colour), points (n, 3) in metres.
            frames: Number of frames that show the pose.

        Raises:
            ValueError: A shape is wrong, the model has no such camera or field, or the video is closed.
            NoVideoError: Rendering has failed.
        """
        self._check()
        if self._ended:
            raise ValueError(f"the video {self.out} is closed")
        shot = Shot(
            pose=self._pose(qpos, mocap_pos, mocap_quat),
            model_fields={name: self._field(name, value) for name, value in (model_fields or {}).items()},
            camera=None if camera is None else camera_values(find_camera(self.model, camera)),
            ghosts=[(self._pose(*ghost[:3]), _colour(ghost[3])) for ghost in ghosts],
            lines=[(_array("points of a line", points, (-1, 3)), _colour(rgba), _LINE_WIDTH) for points, rgba in lines],
            frames=whole_number("frames", frames, low=1),
        )
        with self._changed:
            self._added += frames
            if len(self._poses) < self._most:
                self._poses.append(shot)
            else:
                self._poses[-1]["frames"] += frames
                self._dropped += frames
            self._changed.notify_all()

    def end(self, *, drop: bool = False) -> None:
        """Accept no more poses, and finish the video in the background.

        Args:
            drop: Whether to drop the poses in the queue.
        """
        with self._changed:
            self._ended = True
            if drop:
                self._dropped += sum(shot["frames"] for shot in self._poses)
                self._poses.clear()
            self._changed.notify_all()

    def wait(self, seconds: float = math.inf, *, progress: Progress | bool = True) -> bool:
        """Wait until rendering has ended; return whether it has.

        Args:
            seconds: Timeout.
            progress: As in ``close``.
        """
        shown, until = 0, time.monotonic() + seconds
        with contextlib.nullcontext() if self.finished or seconds <= 0 else _shown_progress(progress) as report:
            while (not self.finished or self._drawn > shown) and (left := until - time.monotonic()) > 0:
                with self._changed:
                    self._changed.wait(min(left, 0.1))
                if self._drawn > shown:
                    shown = self._drawn
                    if report is not None:
                        report(shown, self._added)
        return self.finished

    def close(self, *, progress: Progress | bool = True) -> Path:
        """Accept no more poses, and wait until the file is complete.

        An exception meanwhile, such as Ctrl-C, cancels the video.

        Args:
            progress: Called regularly with the numbers of drawn and of added frames. True and False are as in
                ``write_video``.

        Returns:
            The file's path.

        Raises:
            NoVideoError: Rendering has failed, or there is no pose.
            ValueError: The video was cancelled.
            OSError: The file cannot be written.
        """
        self.end()
        if not self._cancelled:
            try:
                self.wait(progress=progress)
            except BaseException:
                self.cancel()
                raise
        if self._cancelled:
            raise ValueError(f"the video {self.out} was cancelled")
        self._check()
        return self.out

    def cancel(self) -> None:
        """Cancel the video at once, and write no file, unless it is complete."""
        if self._thread.is_alive():
            self._cancelled = True
            self.end(drop=True)
            self._drawing.abandon()
            self._thread.join(_KILLED)

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _draw(self) -> None:
        """Draw poses from the queue, in a thread."""
        try:
            with self._drawing as drawing:
                while (shot := self._next()) is not None:
                    drawing.draw(shot)
                    with self._changed:
                        self._drawn += shot["frames"]
                        self._changed.notify_all()
                if not self._cancelled:
                    drawing.finish()
        except (NoVideoError, OSError) as error:
            self._error = None if self._cancelled else error
        except Exception as error:  # close raises it: the thread has no caller
            self._error = NoVideoError(f"the video could not be written ({' '.join(str(error).split())})")

    def _next(self) -> Shot | None:
        """The next pose, or None after the last one."""
        with self._changed:
            self._changed.wait_for(lambda: self._poses or self._ended)
            return self._poses.popleft() if self._poses else None

    def _pose(
        self, qpos: ArrayLike, mocap_pos: ArrayLike | None, mocap_quat: ArrayLike | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        nmocap = self.model.nmocap
        return (
            _array("qpos", qpos, (self.model.nq,)),
            _array("mocap_pos", self._mocap[0] if mocap_pos is None else mocap_pos, (nmocap, 3)),
            _array("mocap_quat", self._mocap[1] if mocap_quat is None else mocap_quat, (nmocap, 4)),
        )

    def _field(self, name: str, value: ArrayLike) -> np.ndarray:
        owner = self.model if hasattr(self.model, name) else self.model.opt
        wanted = getattr(owner, name, None)
        if not isinstance(wanted, np.ndarray | float | int):
            raise ValueError(f"the model has no field {name!r}")
        return _array(name, value, (np.size(wanted),), flat=True)


def _array(name: str, value: Any, shape: tuple[int, ...], *, flat: bool = False) -> np.ndarray:
    """Copy an array as float64, and check its shape."""
    try:
        array = np.array(value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers, not {value!r}") from None
    array = array.ravel() if flat else array
    if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        wanted = "(n, 3)" if -1 in shape else str(shape)
        raise ValueError(f"{name} must have the shape {wanted}, not {array.shape}")
    return array


def _colour(value: ArrayLike) -> tuple[float, ...]:
    return tuple(_array("a colour", value, (4,)).tolist())
