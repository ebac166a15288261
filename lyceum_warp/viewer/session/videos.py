"""Take videos of what a viewer shows; subprocesses draw them."""

import contextlib
import datetime
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco

from lyceum_warp.support.interrupts import obeyed
from lyceum_warp.viewer.protocol import BEST_COLOUR, TRACE_COLOUR, Camera, Frame
from lyceum_warp.viz import NoVideoError
from lyceum_warp.viz.video import Recorder

FPS = 30
_MOST_WAITING = 4 * FPS  # poses of a video that wait for its process, which takes a while to start
_PATIENCE = 120.0  # seconds that videos get to be drawn when the viewer ends; a signal ends the wait
_GRACE = 5.0  # seconds that they get after that to be completed with what is drawn


class VideoTaker:
    """Takes videos, one at a time; those before may still be drawn.

    Args:
        model: The model that is shown.
        title: What the files' names begin with.
        folder: Where the files go.
    """

    def __init__(self, model: mujoco.MjModel, title: str, folder: Path | None = None) -> None:
        self._model, self._title, self._folder = model, title, folder or Path()
        self._running: Recorder | None = None
        self._drawing: list[Recorder] = []
        self._names: set[str] = set()
        self._start = 0.0

    @property
    def name(self) -> str | None:
        """The video that is taken."""
        return None if self._running is None else self._running.out.name

    @property
    def due(self) -> bool:
        """Whether the video needs a pose."""
        return self._running is not None and (time.perf_counter() - self._start) * FPS >= self._running.added

    def begin(self, camera: Camera | None) -> None:
        """Begin a video.

        Args:
            camera: Where it is seen from; by default as in ``lyceum-warp eval --video``.

        Raises:
            NoVideoError: A package for videos is not installed, or the camera does not exist.
        """
        self.end()
        with _one_error():
            chosen = None if camera is None else mujoco_camera(camera)
            self._running = Recorder(self._model, self._file(), camera=chosen, fps=FPS, most_waiting=_MOST_WAITING)
        self._start = time.perf_counter()

    def add(self, frame: Frame) -> None:
        """Take a frame for the time since the one before.

        Raises:
            NoVideoError: The drawing has failed, or the frame does not fit the model.
        """
        video, pose = self._running, frame.pose
        if video is None:
            return
        lines: list[Any] = []
        if frame.traces is not None:
            lines = [(path, BEST_COLOUR if i == frame.best else TRACE_COLOUR) for i, path in enumerate(frame.traces)]
        ghosts = [(g.pose.qpos, g.pose.mocap_pos, g.pose.mocap_quat, g.colour) for g in frame.ghosts]
        count = int((time.perf_counter() - self._start) * FPS) + 1 - video.added
        if count > 0:
            with _one_error():
                video.add(
                    pose.qpos, pose.mocap_pos, pose.mocap_quat, model_fields=frame.model_fields, ghosts=ghosts,
                    lines=lines, frames=count,
                )  # fmt: skip

    def end(self) -> None:
        """End the video. It is completed in the background."""
        if self._running is not None:
            self._running.end()
            self._drawing.append(self._running)
            self._running = None

    def completed(self) -> list[str]:
        """Messages about videos that are complete, or failed."""
        done = [video for video in self._drawing if video.finished]
        self._drawing = [video for video in self._drawing if video not in done]
        return [_completed(video) for video in done]

    def give_up(self) -> None:
        """Give up the video that is taken, after an error."""
        if self._running is not None:
            self._running.cancel()
            self._running = None

    def finish(self, show: Callable[[str], object], *, seconds: float = _PATIENCE) -> None:
        """Wait until every video is complete, or its time is over.

        After the time a video is completed with what is drawn. One that is not complete a few seconds later is given
        up. An exception while it waits, such as a second Ctrl-C, gives up all of them.

        Args:
            show: Called with a line about each.
            seconds: How long, for all of them together.
        """
        self.end()
        try:
            with obeyed():
                self._wait(seconds)
                for video in self._drawing:
                    video.end(drop=True)
                self._wait(_GRACE)
        except BaseException:
            self.cancel()
            raise
        videos, self._drawing = self._drawing, []
        for video in videos:
            if not video.finished:
                video.cancel()
            show(_completed(video))

    @contextlib.contextmanager
    def finishing(self, show: Callable[[str], object]) -> Iterator[None]:
        """A context at whose end every video is finished; after an exception, such as Ctrl-C, with what is drawn.

        Args:
            show: Called with a line about each.
        """
        try:
            yield
        except BaseException:
            self.finish(show, seconds=0.0)
            raise
        self.finish(show)

    def cancel(self) -> None:
        """Give up all videos at once: those that are not complete are not written."""
        self.end()
        videos, self._drawing = self._drawing, []
        for video in videos:
            video.cancel()

    def _wait(self, seconds: float) -> None:
        """Wait until all videos have ended, for some seconds in all."""
        end = time.monotonic() + seconds
        for video in self._drawing:
            video.wait(end - time.monotonic())

    def _file(self) -> Path:
        """A new file's path. Videos of one second get numbers."""
        title = re.sub(r"[^\w.-]+", "-", self._title)  # may be any text, a file's path among them
        stem = f"{title}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
        name, number = f"{stem}.mp4", 1
        while name in self._names or (self._folder / name).exists():
            number += 1
            name = f"{stem}-{number}.mp4"
        self._names.add(name)
        return self._folder / name


@contextlib.contextmanager
def _one_error() -> Iterator[None]:
    """Every error of a video as a NoVideoError."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise NoVideoError(str(error)) from error


def _completed(video: Recorder) -> str:
    """A line about a video that has ended."""
    try:
        line = f"video: {video.close(progress=False)}"
    except (NoVideoError, ValueError, OSError) as error:
        return f"no video: {error}"
    if not video.dropped:
        return line
    return f"{line} ({video.dropped} of {video.added} frames dropped, which came faster than they were drawn)"


def mujoco_camera(camera: Camera) -> mujoco.MjvCamera:
    """A camera of the window, as MuJoCo describes it."""
    view = mujoco.MjvCamera()
    view.lookat[:] = camera.lookat
    view.distance, view.azimuth, view.elevation = camera.distance, camera.azimuth, camera.elevation
    if camera.fixed >= 0:
        view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera.fixed
    elif camera.tracked_body >= 0:
        view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, camera.tracked_body
    return view
