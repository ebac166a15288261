"""Make videos of the viewer in subprocesses."""

import contextlib
import datetime
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco

from lyceum_warp.support.interrupts import obeyed
from lyceum_warp.viewer.protocol import BEST_COLOUR, TRACE_COLOUR, Frame
from lyceum_warp.viz import NoVideoError
from lyceum_warp.viz.video import Recorder

FPS = 30
_MOST_WAITING = 4 * FPS  # poses that wait for the drawing process, which starts slowly
_PATIENCE = 120.0  # seconds to finish drawing when the viewer ends; a signal ends the wait
_GRACE = 5.0  # further seconds to complete the files with the frames drawn so far


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

    def begin(self, camera: dict[str, Any] | None) -> None:
        """Start a video, after ending the one before.

        Args:
            camera: Attributes of the ``mujoco.MjvCamera``; None for the camera of ``lyceum-warp eval --video``.

        Raises:
            NoVideoError: A package for videos is not installed.
        """
        self.end()
        title = re.sub(r"[^\w.-]+", "-", self._title)  # the title may be a path
        file = self._folder / f"{title}-{datetime.datetime.now():%Y%m%d-%H%M%S-%f}.mp4"
        chosen = None if camera is None else mujoco.MjvCamera()
        for name, value in (camera or {}).items():
            setattr(chosen, name, value)
        self._running = Recorder(self._model, file, camera=chosen, fps=FPS, most_waiting=_MOST_WAITING)
        self._start = time.perf_counter()

    def add(self, frame: Frame) -> None:
        """Add a frame, which lasts until now.

        Raises:
            NoVideoError: The drawing has failed.
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
        """Finish all videos at the end of a ``with`` block; after an exception, such as Ctrl-C, with the frames drawn.

        Args:
            show: Called with a line about each.
        """
        try:
            yield
        except BaseException:
            self.finish(show, seconds=0.0)
            raise
        self.finish(show)

    def finish(self, show: Callable[[str], object], *, seconds: float = _PATIENCE) -> None:
        """Wait until all videos are complete.

        After ``seconds``, a video ends with the frames drawn; if it is incomplete a few seconds later, it is discarded.
        An exception during the wait, such as a second Ctrl-C, discards all of them.

        Args:
            show: Called with a line about each.
            seconds: Time for all videos together.
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

    def cancel(self) -> None:
        """Discard all videos that are not complete."""
        self.end()
        videos, self._drawing = self._drawing, []
        for video in videos:
            video.cancel()

    def _wait(self, seconds: float) -> None:
        """Wait until all videos are complete, for some seconds in all."""
        end = time.monotonic() + seconds
        for video in self._drawing:
            video.wait(end - time.monotonic())


def _completed(video: Recorder) -> str:
    """Format a line about a video that has ended."""
    try:
        line = f"video: {video.close(progress=False)}"
    except (NoVideoError, ValueError, OSError) as error:
        return f"no video: {error}"
    if not video.dropped:
        return line
    return f"{line} ({video.dropped} of {video.added} frames dropped, which came faster than they were drawn)"
