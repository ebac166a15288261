"""Make videos of the viewer in subprocesses."""

import contextlib
import datetime
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.support.interrupts import obeyed
from lyceum_warp.viewer.protocol import BEST_COLOUR, TRACE_COLOUR, Frame, Pose
from lyceum_warp.viz import NoVideoError
from lyceum_warp.viz.render import Shot
from lyceum_warp.viz.video import Recorder

FPS = 30
_WIDTH = 2.0  # of lines, pixels
_MOST_WAITING = 4 * FPS  # poses that wait for the drawing process, which starts slowly
_PATIENCE = 120.0  # seconds to finish drawing when the viewer ends; a signal discards the videos


class VideoTaker:
    """Makes one video at a time; earlier videos may still be drawn.

    Args:
        model: The model.
        title: Prefix of the file names.
        folder: Folder of the files.
    """

    def __init__(self, model: mujoco.MjModel, title: str, folder: Path | None = None) -> None:
        self._model, self._title, self._folder = model, title, folder or Path()
        self._running: Recorder | None = None
        self._drawing: list[Recorder] = []
        self._start = 0.0

    @property
    def name(self) -> str | None:
        """Name of the current video; None without one."""
        return None if self._running is None else self._running.out.name

    @property
    def due(self) -> bool:
        """Whether the video needs a frame."""
        return self._running is not None and (time.perf_counter() - self._start) * FPS >= self._running.added

    def begin(self, camera: dict[str, Any]) -> None:
        """Start a video, after ending the one before.

        Args:
            camera: Attributes of the ``mujoco.MjvCamera``.

        Raises:
            NoVideoError: A package for videos is not installed.
        """
        self.end()
        title = re.sub(r"[^\w.-]+", "-", self._title)  # the title may be a path
        file = self._folder / f"{title}-{datetime.datetime.now():%Y%m%d-%H%M%S-%f}.mp4"
        chosen = mujoco.MjvCamera()
        for name, value in camera.items():
            setattr(chosen, name, value)
        self._running = Recorder(self._model, file, camera=chosen, fps=FPS, most_waiting=_MOST_WAITING)
        self._start = time.perf_counter()

    def add(self, frame: Frame) -> None:
        """Add a frame, which lasts until now.

        Raises:
            NoVideoError: The drawing has failed.
        """
        video = self._running
        if video is None or (count := int((time.perf_counter() - self._start) * FPS) + 1 - video.added) <= 0:
            return
        paths = () if frame.traces is None else frame.traces
        lines = [(path, BEST_COLOUR if i == frame.best else TRACE_COLOUR, _WIDTH) for i, path in enumerate(paths)]
        ghosts = [(_numbers(ghost.pose), ghost.colour) for ghost in frame.ghosts]
        video.add(
            Shot(
                pose=_numbers(frame.pose), model_fields=frame.model_fields, ghosts=list(ghosts), lines=list(lines),
                frames=count,
            )
        )  # fmt: skip

    def end(self) -> None:
        """End the video. It is completed in the background."""
        if self._running is not None:
            self._running.end()
            self._drawing.append(self._running)
            self._running = None

    def completed(self) -> list[str]:
        """Messages about videos that are complete or have failed."""
        done = [video for video in self._drawing if video.finished]
        self._drawing = [video for video in self._drawing if video not in done]
        return [_completed(video) for video in done]

    def give_up(self) -> None:
        """Discard the current video."""
        if self._running is not None:
            self._running.cancel()
            self._running = None

    @contextlib.contextmanager
    def finishing(self, show: Callable[[str], object]) -> Iterator[None]:
        """Finish all videos at the end of a ``with`` block, also after an exception, such as Ctrl-C.

        A video that is incomplete after two minutes, or at a second Ctrl-C, is discarded.

        Args:
            show: Called with a line about each video.
        """
        try:
            yield
        finally:
            self.end()
            end = time.monotonic() + _PATIENCE
            try:
                with obeyed():
                    for video in self._drawing:
                        video.wait(end - time.monotonic())
            finally:
                for video in self._drawing:
                    video.cancel()  # cancelling has no effect on a complete video
                    show(_completed(video))


def _numbers(pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return pose.qpos, pose.mocap_pos, pose.mocap_quat


def _completed(video: Recorder) -> str:
    """Format a line about a video that has ended."""
    try:
        line = f"video: {video.close()}"
    except (NoVideoError, OSError) as error:
        return f"no video: {error}"
    if not video.dropped:
        return line
    return f"{line} ({video.dropped} of {video.added} frames dropped, which came faster than they were drawn)"
