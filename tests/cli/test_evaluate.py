import json
import shutil
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch
from training_runs import refused, train

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.controllers import episode_env, load_episodes
from lyceum_warp.training import load
from lyceum_warp.viz import find_camera, policy_videos


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "[" / "bold]x"  # rich must not parse this name as markup
    assert train(out, "--iterations", "2") == 0
    return out


def test_run_from_a_gpu_is_evaluated_on_a_cpu(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    config = json.loads((run / "config.json").read_text())
    config |= {"device": "cuda:7", "physics": config["physics"] | {"nconmax": 16}}
    (run / "config.json").write_text(json.dumps(config))
    assert cli.main(["eval", str(run), "--episodes", "2"]) == 0
    assert "2 episodes of the mean policy" in capsys.readouterr().out
    assert cli.main(["eval", str(run), "--episodes", "2", "--engine", "warp"]) == 2
    assert "no device 'cuda:7'" in capsys.readouterr().err


def test_eval_with_equal_seeds_prints_equal_statistics(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    outputs = []
    for seed in ("7", "7", "8"):
        assert cli.main(["eval", str(trained), "--episodes", "3", "--seed", seed, "--nworld", "2"]) == 0
        outputs.append(capsys.readouterr().out)
    assert outputs[0] == outputs[1] != outputs[2]
    assert f"3 episodes of the mean policy in {trained}" in outputs[0]
    lines = {line.split()[0]: line.split() for line in outputs[0].splitlines() if line.split()}
    assert lines["length"] == ["length", "256", "0", "256", "256"]
    mean, std, low, high = (float(number) for number in lines["return"][1:])
    assert low <= mean <= high
    assert std > 0
    assert "success:" in lines


def test_eval_saves_the_evaluated_episodes(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, options = tmp_path / "episodes", ["--episodes", "3", "--nworld", "2", "--seed", "7"]
    assert cli.main(["eval", str(trained), *options, "--episodes-to", str(out)]) == 0
    shown = capsys.readouterr().out
    lines = {line.split()[0]: line.split() for line in shown.splitlines() if line.split()}
    episodes = list(load_episodes(out).values())
    assert [file.name for file in sorted(out.iterdir())] == [f"episode-00{i}.npz" for i in range(3)]
    returns = torch.tensor([episode.episode_return for episode in episodes])
    assert returns.mean().item() == pytest.approx(float(lines["return"][1]), rel=1e-4)
    assert all(episode.steps == 256 and episode.controller["run"] == str(trained) for episode in episodes)
    env = episode_env(episodes[2])
    env.set_state(episodes[2].states[9:10])
    env.step(load(trained)(env.obs))
    torch.testing.assert_close(env.get_state()[0], episodes[2].states[10], rtol=1e-6, atol=1e-6)
    assert cli.main(["eval", str(trained), *options, "--episodes-to", str(out)]) == 2
    refused(capsys, f"{out} exists and is not an empty folder: use another folder")


def test_video_is_made_with_the_named_camera(
    trained: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    cameras = []

    def write_video(env: lw.Env, states: torch.Tensor, path: Path, **options: Any) -> Path:
        cameras.append(find_camera(env.model, options["camera"]))
        return path

    monkeypatch.setattr(policy_videos, "write_video", write_video)
    for words in (["0"], ["azimuth=30", "track=agent"]):
        flags = [flag for word in words for flag in ("--camera", word)]
        assert cli.main(["eval", str(trained), "--episodes", "1", "--horizon", "9", "--video", *flags]) == 0
    fixed, tracking = cameras
    assert fixed.fixedcamid == 0
    assert (tracking.azimuth, tracking.type) == (30, mujoco.mjtCamera.mjCAMERA_TRACKING)


def test_eval_compares_both_engines(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["eval", str(trained), "--episodes", "64", "--horizon", "20", "--transfer"]
    assert cli.main(arguments) == 0
    shown = capsys.readouterr().out
    assert "Warp engine on cpu against C engine: same" in shown
    rows = [line.split() for line in shown.splitlines() if line.split()[:1] == ["length"]]
    assert rows[-1] == ["length", "20", "20", "+0", "+0", "to", "+0", "1", "same"]


@pytest.mark.parametrize(("options", "words"), [
    (["--episodes", "0"], ["episodes", "0"]),
    (["--transfer", "--engine", "warp"], ["--transfer", "--engine"]),
    (["--video", "--camera", "side"], ["'side'"]),
    (["--camera", "0"], ["--camera", "--video"]),
    (["--memory", "level=1", "--fresh-memory"], ["--memory", "--fresh-memory"]),
])  # fmt: skip
def test_invalid_eval_options_print_one_line(
    options: list[str], words: list[str], trained: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    assert cli.main(["eval", str(trained), "--episodes", "1", *options]) == 2
    refused(capsys, *words)
