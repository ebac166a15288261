import logging
from pathlib import Path

import pytest

import lyceum_warp as lw
from lyceum_warp.viz import renderer

SMALL = lw.NPGConfig(samples=12, hidden=(4,), value_hidden=(4,))


@pytest.fixture
def npg() -> lw.NPG:
    return lw.NPG(lw.make("point_mass", nworld=2, horizon=6), config=SMALL)


def test_training_in_python_writes_the_same_videos_as_the_command_line(npg: lw.NPG, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="there is no camera 'side': the model has"):
        lw.train(npg, tmp_path / "run", iterations=2, video_every=1, camera="side")
    with pytest.raises(ValueError, match="video_every must be a whole number from 0 to .*, not -1"):
        lw.train(npg, tmp_path / "run", iterations=2, video_every=-1)
    assert not (tmp_path / "run").exists()
    seen: list[int] = []
    callback = lambda it: seen.append(it.iteration)  # noqa: E731
    run = lw.train(npg, tmp_path / "run", iterations=4, video_every=2, camera="free", callback=callback)
    assert run.config["video_every"] == 2 and seen == [1, 2, 3, 4]
    if not (run.folder / "videos").exists():
        pytest.skip("this machine cannot render")
    assert sorted(path.name for path in (run.folder / "videos").iterdir()) == ["000002.mp4", "000004.mp4"]


def test_training_in_python_continues_if_no_video_can_be_drawn(
    npg: lw.NPG, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(renderer, "backends", lambda: ["nonsense"])
    with caplog.at_level(logging.WARNING):
        run = lw.train(npg, tmp_path / "run", iterations=2, video_every=1)
    assert len(run.rows()) == 2 and not (run.folder / "videos").exists()
    (message,) = caplog.messages
    assert message.startswith("no further videos (this machine cannot render off-screen (nonsense: ")
