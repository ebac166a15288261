"""Make videos, pictures and HTML pages of what the viewer shows."""

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
from lyceum_warp.viewer.protocol import BEST_COLOUR, TRACE_COLOUR, Frame
from lyceum_warp.viz import NoVideoError, Recorder, Shot, write_states

FPS = 30
_PICTURE_SIZE = (1280, 960)
_WIDTH = 2.0  # width of lines, in pixels
_MOST_WAITING = 4 * FPS  # poses queue up while the rendering subprocess starts; this is their maximum number
_PATIENCE = 120.0  # seconds to finish videos when the viewer ends


class VideoTaker:
    """Records one video at a time. Earlier videos and pictures may still be rendered in the background."""

    def __init__(self, model: mujoco.MjModel, title: str) -> None:
        self._model, self._title = model, title
        self._video: Recorder | None = None
        self._recorders: list[Recorder] = []  # of all files that are not complete
        self._start = 0.0
        self._states: list[np.ndarray] = []
        self._camera: dict[str, Any] = {}
        self._messages: list[str] = []
        self.files: list[Path] = []

    @property
    def name(self) -> str | None:
        """The name of the current video."""
        return None if self._video is None else self._video.out.name

    @property
    def due(self) -> bool:
        """Whether the video needs a frame."""
        return self._video is not None and (time.perf_counter() - self._start) * FPS >= self._video.added

    def begin(self, camera: dict[str, Any]) -> None:
        """End the current video, and start another one."""
        self.end()
        self._camera, self._states = camera, []
        self._video = Recorder(self._model, self._file(".mp4"), camera=camera, fps=FPS, most_waiting=_MOST_WAITING)
        self._recorders.append(self._video)
        self._start = time.perf_counter()

    def picture(self, camera: dict[str, Any], frame: Frame) -> None:
        """Render a picture of a frame."""
        out = self._file(".png")
        picture = Recorder(self._model, out, camera=camera, size=_PICTURE_SIZE, fps=None, most_waiting=1)
        picture.add(_shot(frame, 1))
        picture.end()
        self._recorders.append(picture)

    def _file(self, ending: str) -> Path:
        title = re.sub(r"[^\w.-]+", "-", self._title, flags=re.ASCII)  # the title may be a task's path
        return Path(f"{title}-{datetime.datetime.now():%Y%m%d-%H%M%S-%f}{ending}")

    def add(self, frame: Frame) -> None:
        """Repeat a frame until the video reaches the present time."""
        video = self._video
        if video is None or (count := int((time.perf_counter() - self._start) * FPS) + 1 - video.added) <= 0:
            return
        self._states += [frame.state] * count
        video.add(_shot(frame, count))

    def end(self) -> None:
        """Stop adding frames to the video, and write its page. A subprocess finishes the video file."""
        if (video := self._video) is None:
            return
        self._video = None
        video.end()
        if not self._states:
            return
        page = video.out.with_suffix(".html")
        try:
            write_states(self._model, self._states, page, dt=1 / FPS, title=self._title, camera=self._camera)
        except OSError as error:
            self._messages.append(f"no page: {error}")
        else:
            self._messages.append(f"page: {page}")
            self.files.append(page)

    def completed(self) -> list[str]:
        """Return a message for each video, picture or page that was completed or has failed since the last call."""
        completed = [recorder for recorder in self._recorders if recorder.finished]
        for recorder in completed:
            self._recorders.remove(recorder)
            self._messages.append(_message(recorder))
            if recorder is self._video:  # it failed
                self._video = None
            if recorder.out.exists():
                self.files.append(recorder.out)
        messages, self._messages = self._messages, []
        return messages

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
                    for recorder in self._recorders:
                        recorder.wait(end - time.monotonic())
            finally:
                for recorder in self._recorders:
                    recorder.cancel()  # no effect on a complete video
                for message in self.completed():
                    show(message)


def _shot(frame: Frame, count: int) -> Shot:
    paths = () if frame.traces is None else frame.traces
    lines = [(path, BEST_COLOUR if i == 0 else TRACE_COLOUR, _WIDTH) for i, path in enumerate(paths)]
    lines += [(np.stack([arrow.start, arrow.end]), arrow.colour, 2 * _WIDTH) for arrow in frame.arrows]
    return Shot(
        state=frame.state, model_fields=frame.model_fields, lines=list(lines), frames=count,
        ghosts=[(ghost.state, ghost.colour, ghost.shift) for ghost in frame.ghosts],
    )  # fmt: skip


def _message(recorder: Recorder) -> str:
    kind = "picture" if recorder.out.suffix == ".png" else "video"
    try:
        message = f"{kind}: {recorder.close()}"
    except (NoVideoError, OSError) as error:
        return f"no {kind}: {error}"
    if not recorder.dropped:
        return message
    return (
        f"{message} ({recorder.dropped} of {recorder.added} frames dropped, which came faster than they were rendered)"
    )
