import contextlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from conftest import SharedEnv
from memory_window import MemoryWindow

from lyceum_warp.support.interrupts import Interrupted, signals
from lyceum_warp.viewer.commands import Command, command, set_video, take_picture
from lyceum_warp.viewer.protocol import Frame
from lyceum_warp.viewer.session import videos
from lyceum_warp.viewer.session.clock import Session
from lyceum_warp.viewer.session.videos import VideoTaker
from lyceum_warp.viz import renderer
from lyceum_warp.viz.video import NoVideoError

CAMERA = dict(type=1, trackbodyid=1, fixedcamid=-1, lookat=[0.0, 0.0, 1.0], distance=4.0, azimuth=90.0,
              elevation=-20.0)  # fmt: skip


def test_a_video_of_the_session_is_written_and_reported(
    shared_env: SharedEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    def after(frame: Frame, number: int) -> list[Command] | None:
        assert (frame.status.video is not None) == (0 < number <= 15)
        return {
            0: [command(set_video, CAMERA), command(take_picture, CAMERA)],
            15: [command(set_video, None)],
            16: None,
        }.get(number, [])

    window = MemoryWindow(after)
    Session(shared_env("hopper")).run(window)  # type: ignore[arg-type]
    told = "\n".join([*window.messages, capsys.readouterr().out])
    if "this machine cannot render" in told:
        pytest.skip(told)
    heads = {"mp4": b"ftyp", "png": b"\r\n\x1a\n", "html": b"ctyp"}
    for kind, ending in (("video", "mp4"), ("picture", "png"), ("page", "html")):
        (file,) = tmp_path.glob(f"hopper-*.{ending}")
        assert f"{kind}: {file.name}" in told and file.read_bytes()[4:8] == heads[ending]


@pytest.fixture
def frame(shared_env: SharedEnv) -> Frame:
    return Session(shared_env("hopper"), paused=True).stage.frame()


@pytest.fixture
def taker(shared_env: SharedEnv, tmp_path: Path) -> Iterator[VideoTaker]:
    with contextlib.chdir(tmp_path):
        yield VideoTaker(shared_env("hopper").task.model, "runs/one two")


def take(taker: VideoTaker, frame: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
    rendered, render = threading.Event(), renderer.Renderer.render

    def slow(self: renderer.Renderer, shot: Any) -> None:
        render(self, shot)
        rendered.set()
        time.sleep(0.5)

    monkeypatch.setattr(renderer.Renderer, "render", slow)
    monkeypatch.setattr(videos, "FPS", 5)  # without a GPU, rendering is slow, so the video must omit some poses
    try:
        taker.begin(CAMERA)
        while not rendered.is_set():
            taker.add(frame)
            time.sleep(0.02)
        for _ in range(10):
            taker.add(frame)
            time.sleep(0.04)
    except NoVideoError as error:
        pytest.skip(str(error))


def test_a_second_signal_discards_the_videos(
    taker: VideoTaker, frame: Frame, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    begin, lines = 0.0, []
    with signals(), pytest.raises(Interrupted), taker.finishing(lines.append):
        take(taker, frame, monkeypatch)
        begin = time.monotonic()
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
        signal.raise_signal(signal.SIGTERM)
    assert 0 < time.monotonic() - begin < 6
    (page,) = tmp_path.iterdir()
    assert lines[0] == f"page: {page.name}" and "was cancelled" in lines[1]
