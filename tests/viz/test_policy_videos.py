import logging
from pathlib import Path

import pytest

import lyceum_warp as lw
from lyceum_warp.viz import drawing
from lyceum_warp.viz.policy_videos import Videos
from lyceum_warp.viz.tensorboard import TensorBoard

SMALL = lw.NPGConfig(samples=12, hidden=(4,), value_hidden=(4,))


@pytest.fixture
def npg() -> lw.NPG:
    return lw.NPG(lw.make("point_mass", nworld=2, horizon=6), config=SMALL)


def test_videos_are_written_every_few_iterations_and_shown_in_tensorboard(npg: lw.NPG, tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    board, shown = TensorBoard(tmp_path / "board", {}), []
    videos = Videos(npg, tmp_path / "videos", 2, 0, board, progress=lambda *counts: shown.append(counts))
    for _ in range(4):
        videos(next(npg))
        if not videos.every:
            pytest.skip("this machine cannot draw")
    board.close()
    assert sorted(path.name for path in (tmp_path / "videos").iterdir()) == ["000002.mp4", "000004.mp4"]
    images = EventAccumulator(str(tmp_path / "board"), {"images": 0}).Reload().Images("video")
    assert [image.step for image in images] == [24, 48]
    assert shown[:7] == shown[7:] == [("drawing the video", "frames", i, 7) for i in range(1, 8)]


@pytest.mark.parametrize("error", [ValueError("ffmpeg gave\nno picture"), ImportError("x"), OSError(28, "disk full")])
def test_a_video_that_cannot_be_converted_is_reported_once(npg: lw.NPG, error: Exception, tmp_path: Path) -> None:
    class Board:
        def video(self, path: Path, samples: int) -> None:
            raise error

    notes: list[str] = []
    videos = Videos(npg, tmp_path / "videos", 1, 0, Board(), note=notes.append)  # type: ignore[arg-type]
    for _ in range(2):
        videos(next(npg))
    if "cannot draw" in notes[0]:
        pytest.skip(notes[0])
    assert notes == [f"no further videos ({' '.join(str(error).split())})"]


def test_python_gets_the_videos_of_the_command_line(npg: lw.NPG, tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    with pytest.raises(ValueError, match="there is no camera 'side': the model has"):
        lw.train(npg, tmp_path / "run", iterations=2, video_every=1, camera="side")
    with pytest.raises(ValueError, match="video_every must be a whole number from 0 to .*, not -1"):
        lw.train(npg, tmp_path / "run", iterations=2, video_every=-1)
    assert not (tmp_path / "run").exists()
    seen: list[int] = []
    callback = lambda it: seen.append(it.iteration)  # noqa: E731
    run = lw.train(npg, tmp_path / "run", iterations=2, video_every=2, camera="free", callback=callback)
    assert run.config["video_every"] == 2 and seen == [1, 2]
    if not (run.folder / "videos").exists():
        pytest.skip("this machine cannot draw")
    assert [path.name for path in (run.folder / "videos").iterdir()] == ["000002.mp4"]


def test_training_in_python_goes_on_where_no_video_can_be_drawn(
    npg: lw.NPG, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(drawing, "libraries", lambda: ["nonsense"])
    with caplog.at_level(logging.WARNING):
        run = lw.train(npg, tmp_path / "run", iterations=2, video_every=1)
    assert len(run.rows()) == 2 and not (run.folder / "videos").exists()
    (message,) = caplog.messages
    assert message.startswith("no further videos (this machine cannot draw off-screen (nonsense: ")
