"""Videos of what a viewer shows."""

import dataclasses
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from conftest import SharedEnv
from memory_window import MemoryWindow

from lyceum_warp.support.interrupts import Interrupted, signals
from lyceum_warp.viewer import protocol
from lyceum_warp.viewer.protocol import BEST_COLOUR, TRACE_COLOUR, Camera, Command, Frame
from lyceum_warp.viewer.session.clock import Session
from lyceum_warp.viewer.session.videos import VideoTaker
from lyceum_warp.viz import drawing
from lyceum_warp.viz.video import NoVideoError, check_video


def test_a_video_of_the_session_is_written_and_reported(
    shared_env: SharedEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        check_video()
    except NoVideoError as error:
        pytest.skip(str(error))
    monkeypatch.chdir(tmp_path)
    camera = Camera((0.0, 0.0, 1.0), 4.0, 90.0, -20.0, tracked_body=1)

    def after(frame: Frame, number: int) -> list[Command] | None:
        if number == 0:
            return [protocol.SetVideo(True, camera)]
        if number < 15:
            assert frame.status.video is not None
            return []
        if number == 15:
            return [protocol.SetVideo(False)]
        assert frame.status.video is None
        return None

    Session(shared_env("hopper")).run(MemoryWindow(after))
    printed = capsys.readouterr().out
    if "this machine cannot draw" in printed:
        pytest.skip(printed)
    (video,) = tmp_path.glob("hopper-*.mp4")
    assert f"video: {video.name}" in printed and video.read_bytes()[4:8] == b"ftyp"


def test_a_missing_package_is_a_message(shared_env: SharedEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> None:
        raise NoVideoError("videos need imageio: pip install 'lyceum-warp[viz]'")

    monkeypatch.setattr("lyceum_warp.viz.drawing.check_video", missing)
    session = Session(shared_env("hopper"), paused=True)
    session.obey(protocol.SetVideo(True))
    assert session.stage.frame().messages == ("videos need imageio: pip install 'lyceum-warp[viz]'",)


@pytest.fixture
def frame(shared_env: SharedEnv) -> Frame:
    return Session(shared_env("hopper"), paused=True).stage.frame()


@pytest.fixture
def taker(shared_env: SharedEnv, tmp_path: Path) -> VideoTaker:
    pytest.importorskip("imageio_ffmpeg")
    return VideoTaker(shared_env("hopper").task.model, "hopper", tmp_path)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """A machine that draws two poses a second; the event is set once the first one is drawn."""
    drawn, draw = threading.Event(), drawing.Drawing.draw

    def slow(self: drawing.Drawing, shot: Any) -> None:
        draw(self, shot)
        drawn.set()
        time.sleep(0.5)

    monkeypatch.setattr(drawing.Drawing, "draw", slow)
    return drawn


def take(taker: VideoTaker, frame: Frame, drawn: threading.Event) -> None:
    """Take a video until one pose is drawn and others wait."""
    try:
        taker.begin(None)
        while not drawn.is_set():
            taker.add(frame)
            time.sleep(0.02)
        for _ in range(10):
            taker.add(frame)
            time.sleep(0.04)
    except NoVideoError as error:
        pytest.skip(str(error))


def test_an_interrupted_viewer_ends_its_video_with_what_is_drawn(
    taker: VideoTaker, frame: Frame, drawn: threading.Event, tmp_path: Path
) -> None:
    lines: list[str] = []
    with pytest.raises(Interrupted), taker.finishing(lines.append):
        take(taker, frame, drawn)
        begin = time.monotonic()
        raise Interrupted(signal.SIGINT)
    assert time.monotonic() - begin < 6
    (video,) = tmp_path.iterdir()
    assert len(lines) == 1 and lines[0].startswith(f"video: {video} (")
    assert "frames dropped, which came faster than they were drawn" in lines[0]


def test_a_second_signal_gives_up_the_videos(
    taker: VideoTaker, frame: Frame, drawn: threading.Event, tmp_path: Path
) -> None:
    begin = 0.0
    with signals(), pytest.raises(Interrupted):
        try:
            take(taker, frame, drawn)
            signal.raise_signal(signal.SIGTERM)
        except Interrupted:
            begin = time.monotonic()
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGTERM)).start()
            taker.finish(print, seconds=60.0)
    assert 0 < time.monotonic() - begin < 6
    assert not list(tmp_path.iterdir())


def test_videos_of_one_second_have_different_names(taker: VideoTaker, frame: Frame) -> None:
    names = []
    for _ in range(3):
        taker.begin(None)
        names.append(taker.name)
    taker.cancel()
    assert len(set(names)) == 3 and all(name is not None and name.endswith(".mp4") for name in names)


def test_a_title_may_be_a_path(shared_env: SharedEnv, tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    taker = VideoTaker(shared_env("hopper").task.model, "runs/one two", tmp_path)
    taker.begin(None)
    assert taker.name is not None and taker.name.startswith("runs-one-two-")
    taker.cancel()


def test_every_error_of_a_video_is_one_kind(taker: VideoTaker, frame: Frame, tmp_path: Path) -> None:
    wrong = dataclasses.replace(frame, pose=dataclasses.replace(frame.pose, qpos=np.zeros(3)))
    taker.begin(None)
    with pytest.raises(NoVideoError, match="qpos must have the shape"):
        taker.add(wrong)
    taker.give_up()
    (tmp_path / "file").write_text("")
    taker = VideoTaker(mujoco.MjModel.from_xml_string("<mujoco/>"), "none", tmp_path / "file")
    taker.begin(None)
    lines: list[str] = []
    taker.finish(lines.append)
    assert len(lines) == 1 and lines[0].startswith("no video: ")
    taker.begin(None)
    taker.cancel()
    taker.finish(lines.append)
    assert len(lines) == 1


def test_traces_have_the_colours_of_the_page(taker: VideoTaker, frame: Frame, monkeypatch: pytest.MonkeyPatch) -> None:
    shots: list[Any] = []
    monkeypatch.setattr("lyceum_warp.viz.video.Recorder.add", lambda self, *pose, **shown: shots.append(shown))
    taker.begin(None)
    taker.add(dataclasses.replace(frame, traces=np.zeros((2, 3, 3)), best=1))
    taker.cancel()
    assert [tuple(colour) for _, colour in shots[0]["lines"]] == [TRACE_COLOUR, BEST_COLOUR]
