from pathlib import Path
from typing import Any

import pytest
from memory_window import MemoryWindow
from training_runs import refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.cli.arguments import cameras
from lyceum_warp.controllers import Trajectory
from lyceum_warp.training import Run
from lyceum_warp.viewer import show as views
from lyceum_warp.viewer.protocol import Scene

SMALL = "--iterations 2 --nworld 4 --horizon 12 --mean-every 0 --hidden 8 --channels 2 4 --no-plot".split()


def test_flag_gives_sizes_kinds_and_groups() -> None:
    assert cameras("") == ()
    assert cameras("side") == (lw.Camera("side"),)
    assert cameras("side:32x24:depth") == (lw.Camera("side", 32, 24, "depth"),)
    assert cameras("side,side:depth,top:16x8:rgb") == (
        lw.Camera("side", group="side"), lw.Camera("side", kind="depth", group="side_depth"),
        lw.Camera("top", 16, 8, group="top"),
    )  # fmt: skip


@pytest.mark.parametrize(("text", "words"), [
    ("left", ["no camera 'left'", "it has 'side'"]), ("side:64", ["'side:64'", "NAME:64x64"]),
    ("side:deep", ["kind", "'deep'", "depth"]), ("side:16x16,side:8x8", ["group 'side'", "once for each kind"]),
    ("side:30x30", ["30: use 32"]),
])  # fmt: skip
def test_invalid_cameras_print_one_line(text: str, words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "cartpole", "--algorithm", "ppo", "--cameras", text]) == 2
    refused(capsys, *words)


def test_learner_without_eyes_is_refused_and_empty_flag_omits_the_cameras_of_a_task(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task = tmp_path / "seen.py"
    task.write_text(
        "import lyceum_warp as lw\nfrom lyceum_warp.tasks.point_mass import PointMass\n\n\n"
        "class Seen(PointMass):\n    cameras = (lw.Camera('above', 16, 16),)\n"
    )
    words = ["train", str(task), "--algorithm", "npg", *SMALL[:6], "--no-plot", "--out", str(tmp_path / "run")]
    assert cli.main(words) == 2
    refused(capsys, "NPG cannot learn from cameras", "cameras=[]", "--cameras ''")
    assert cli.main([*words, "--cameras", ""]) == 0
    assert cli.main(["train", "--resume", str(tmp_path / "run"), "--iterations", "3", "--no-plot"]) == 0


def test_pictures_of_saved_episodes_teach_a_policy_that_eval_and_view_show(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planned, clone, saved = (tmp_path / name for name in ("planned", "clone", "saved"))
    plan = ["plan", "cartpole", "--steps", "8", "--samples", "4", "--horizon", "4", "--no-video", "--out", str(planned)]
    assert cli.main([*plan, "--cameras", "side:16x16"]) == 0
    distill = ["--algorithm", "distill", "--demonstrations", str(planned), "--policy-groups", "camera"]
    assert cli.main(["train", "cartpole", *distill, "--cameras", "side:16x16", "--out", str(clone), *SMALL]) == 0
    assert Run.open(clone).config["options"]["cameras"][0]["width"] == 16
    assert cli.main(["train", "--resume", str(clone), "--iterations", "3", "--no-plot"]) == 0
    assert cli.main(["eval", str(clone), "--episodes", "2", "--nworld", "2", "--episodes-to", str(saved)]) == 0
    episode = Trajectory.load(saved / "episode-001.npz")
    assert episode.pictures["camera"].shape == (episode.steps + 1, 16, 16, 3)
    scenes: list[Scene] = []

    def open_window(scene: Scene, **options: Any) -> MemoryWindow:
        scenes.append(scene)
        return MemoryWindow(lambda frame, number: None)

    monkeypatch.setattr(views, "Window", open_window)
    for words in (["cartpole", "--cameras", "side"], ["cartpole"], [str(clone)], [str(saved)]):
        assert cli.main(["view", *words]) == 0
    assert [scene.sees for scene in scenes] == [True, False, True, True]
