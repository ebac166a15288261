import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from memory_window import MemoryWindow
from toy_controllers import towards
from training_runs import interrupted, refused, train

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.viewer import show as views
from lyceum_warp.viewer.protocol import Frame, Scene


class Opened:
    def __init__(self) -> None:
        self.scenes: list[Scene] = []
        self.frames: list[Frame] = []
        self.options: dict[str, Any] = {}
        self.number = 3

    def __call__(self, scene: Scene, **options: Any) -> MemoryWindow:
        self.scenes.append(scene)
        self.options = options

        def after(frame: Frame, number: int) -> list[Any] | None:
            self.frames.append(frame)
            return None if number + 1 >= self.number else []

        return MemoryWindow(after)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Opened:
    collected = Opened()
    monkeypatch.setattr(views, "Window", collected)
    return collected


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert train(folder, "--iterations", "2") == 0
    return folder


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    env = lw.make("point_mass", autoreset=False, horizon=10, success_distance=0.1)
    folder = tmp_path_factory.mktemp("episodes")
    return [lw.control(env, towards, seed=seed).save(folder / f"episode-{seed:03d}.npz") for seed in (0, 1)]


def test_view_shows_a_task(opened: Opened) -> None:
    options = ["--nworld", "3", "--port", "8123", "--param", "success_distance=0.2"]
    assert cli.main(["view", "point_mass", *options]) == 0
    (scene,) = opened.scenes
    assert scene.title == "point_mass" and scene.nworld == 3 and scene.modes == ("passive",)
    assert opened.options == {"host": "127.0.0.1", "port": 8123}


def test_view_shows_the_policy_of_a_run(opened: Opened, run: Path) -> None:
    assert cli.main(["view", str(run), "--seed", "3"]) == 0
    (scene,) = opened.scenes
    assert scene.controllers == ("policy",) and scene.nworld == 16
    assert cli.main(["view", str(run), "--which", "best", "--nworld", "2", "--mppi", "--samples", "4"]) == 0
    assert opened.scenes[1].controllers == ("policy", "mppi") and opened.scenes[1].nworld == 2
    assert cli.main(["view", str(run), "--follow", "--nworld", "1"]) == 0


def test_view_plays_saved_episodes(opened: Opened, files: list[Path]) -> None:
    for words in ([str(file) for file in files], [str(files[0].parent)]):
        assert cli.main(["view", *words]) == 0
        scene = opened.scenes[-1]
        assert scene.modes == ("playback", "passive") and scene.episodes == ("episode-000.npz", "episode-001.npz")
    first = lw.Trajectory.load(files[0])
    shown = torch.from_numpy(opened.frames[0].state)
    assert torch.equal(shown, first.states[0, : len(shown)])


@pytest.mark.parametrize(
    ("words", "messages"),
    [
        (["hoper"], ["'hoper'"]),
        (["point_mass", "--follow"], ["--follow needs a run", "point_mass"]),
        (["point_mass", "--samples", "4"], ["--samples", "--mppi"]),
        (["point_mass", "hopper"], ["one task", "hopper"]),
        (["point_mass", "--nworld", "0"], ["nworld", "0"]),
        (["missing.npz"], ["missing.npz"]),
    ],
)
def test_invalid_view_arguments_print_one_line(
    opened: Opened, capsys: pytest.CaptureFixture[str], words: list[str], messages: list[str]
) -> None:
    assert cli.main(["view", *words]) == 2
    refused(capsys, *messages)
    assert not opened.scenes


def test_ctrl_c_closes_the_window(monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []

    def after(frame: Frame, number: int) -> list[Any]:
        signal.raise_signal(signal.SIGINT)
        return []

    monkeypatch.setattr(MemoryWindow, "close", lambda window: closed.append(True))
    monkeypatch.setattr(views, "Window", lambda *words, **options: MemoryWindow(after))
    assert interrupted(["view", "point_mass"]) == 130
    assert closed == [True]
