"""Make videos, pictures and HTML pages of what the viewer shows."""

import contextlib
import datetime
import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.support.interrupts import obeyed
from lyceum_warp.viewer.protocol import BEST_COLOUR, TRACE_COLOUR, Frame, Pose
from lyceum_warp.viz import NoVideoError
from lyceum_warp.viz.cameras import camera_values
from lyceum_warp.viz.drawing import DrawingProcess, check_video
from lyceum_warp.viz.page import write_poses
from lyceum_warp.viz.render import Shot
from lyceum_warp.viz.video import Recorder

FPS = 30
_PICTURE_SIZE = (1280, 960)
_WIDTH = 2.0  # of lines, pixels
_MOST_WAITING = 4 * FPS  # maximum number of waiting poses; the rendering subprocess starts slowly
_PATIENCE = 120.0  # seconds to finish videos when the viewer ends


class VideoTaker:
    """Records one video at a time. Earlier videos may still be rendered in the background."""

    def __init__(self, model: mujoco.MjModel, title: str, folder: Path | None = None) -> None:
        self._model, self._title, self._folder = model, title, folder or Path()
        self._running: Recorder | None = None
        self._drawing: list[Recorder] = []
        self._start = 0.0
        self._poses: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self._camera = mujoco.MjvCamera()
        self._pictures: list[threading.Thread] = []
        self._done: list[str] = []  # messages about pictures and pages
        self.files: list[Path] = []

    @property
    def name(self) -> str | None:
        """The name of the current video."""
        return None if self._running is None else self._running.out.name

    @property
    def due(self) -> bool:
        """Whether the video needs a frame."""
        return self._running is not None and (time.perf_counter() - self._start) * FPS >= self._running.added

    def begin(self, camera: dict[str, Any]) -> None:
        """End the current video, and start another one."""
        self.end()
        self._camera, self._poses = _camera(camera), []
        self._running = Recorder(
            self._model, self._file(".mp4"), camera=self._camera, fps=FPS, most_waiting=_MOST_WAITING
        )
        self._start = time.perf_counter()

    def picture(self, camera: dict[str, Any], frame: Frame) -> None:
        """Write a picture of a frame in a thread."""
        check_video()
        import imageio.v2 as imageio

        drawing = DrawingProcess(self._model, camera=_camera(camera), size=_PICTURE_SIZE, fps=None, background=True)
        shot, file = _shot(frame, 1), self._file(".png")

        def draw() -> None:
            try:
                with drawing:
                    drawing.draw(shot)
                    imageio.imwrite(file, drawing.picture())
                self._done.append(f"picture: {file}")
                self.files.append(file)
            except (NoVideoError, OSError) as error:
                self._done.append(f"no picture: {error}")

        self._pictures.append(threading.Thread(target=draw, name="lyceum-warp picture", daemon=True))
        self._pictures[-1].start()

    def _file(self, ending: str) -> Path:
        title = re.sub(r"[^\w.-]+", "-", self._title, flags=re.ASCII)  # the title may be a task's path
        return self._folder / f"{title}-{datetime.datetime.now():%Y%m%d-%H%M%S-%f}{ending}"

    def add(self, frame: Frame) -> None:
        """Add a frame as often as needed for the video to reach the present time."""
        video = self._running
        if video is None or (count := int((time.perf_counter() - self._start) * FPS) + 1 - video.added) <= 0:
            return
        self._poses += [_numbers(frame.pose)] * count
        video.add(_shot(frame, count))

    def end(self) -> None:
        """End the video, complete it in the background, and write the page beside it."""
        if self._running is not None:
            self._running.end()
            page = self._running.out.with_suffix(".html")
            view = camera_values(self._camera)
            if self._poses:
                try:
                    write_poses(self._model, self._poses, page, dt=1 / FPS, title=self._title, camera=view)
                    self._done.append(f"page: {page}")
                    self.files.append(page)
                except OSError as error:
                    self._done.append(f"no page: {error}")
            self._drawing.append(self._running)
            self._running = None

    def completed(self) -> list[str]:
        """Return messages about videos that are complete or have failed."""
        done = [video for video in self._drawing if video.finished]
        self._drawing = [video for video in self._drawing if video not in done]
        lines, self._done = [*self._done, *map(_completed, done)], []
        self.files += [video.out for video in done if video.out.exists()]
        return lines

    def give_up(self) -> None:
        """Discard the current video."""
        if self._running is not None:
            self._running.cancel()
            self._running = None

    @contextlib.contextmanager
    def finishing(self, show: Callable[[str], object]) -> Iterator[None]:
        """Finish all videos when the ``with`` block ends, even after an exception, such as Ctrl-C.

        A video that is incomplete after two minutes, or at a second Ctrl-C, is discarded.
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
                    for thread in self._pictures:
                        thread.join(end - time.monotonic())
            finally:
                for video in self._drawing:
                    video.cancel()  # no effect on a complete video
                for line in self.completed():
                    show(line)


def _numbers(pose: Pose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return pose.qpos, pose.mocap_pos, pose.mocap_quat


def _shot(frame: Frame, count: int) -> Shot:
    paths = () if frame.traces is None else frame.traces
    lines = [(path, BEST_COLOUR if i == frame.best else TRACE_COLOUR, _WIDTH) for i, path in enumerate(paths)]
    lines += [(np.stack([arrow.start, arrow.end]), arrow.colour, 2 * _WIDTH) for arrow in frame.arrows]
    ghosts = [(_numbers(ghost.pose), ghost.colour, ghost.shift) for ghost in frame.ghosts]
    return Shot(
        pose=_numbers(frame.pose), model_fields=frame.model_fields, ghosts=list(ghosts), lines=list(lines),
        frames=count,
    )  # fmt: skip


def _camera(values: dict[str, Any]) -> mujoco.MjvCamera:
    chosen = mujoco.MjvCamera()
    for name, value in values.items():
        setattr(chosen, name, value)
    return chosen


def _completed(video: Recorder) -> str:
    try:
        line = f"video: {video.close()}"
    except (NoVideoError, OSError) as error:
        return f"no video: {error}"
    if not video.dropped:
        return line
    return f"{line} ({video.dropped} of {video.added} frames dropped, which came faster than they were drawn)"
