"""Learning curves and videos."""

import json
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.runs import Run
from lyceum_warp.viz import learning_curve as plot
from lyceum_warp.viz import video
from lyceum_warp.viz._render import camera


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Run.create(tmp_path / "run", {"task": "point_mass", "seed": 3})
    for i in range(1, 8):
        run.write({
            "iteration": i, "samples": 100 * i, "return_mean": float(i), "return_std": 0.5, "eval_mean": 1 / i,
            "mean_return": 2.0 * i if i % 3 == 0 else None, "mean_eval": 0.5 if i % 3 == 0 else None,
        })  # fmt: skip
    return run


def is_png(path: Path) -> bool:
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and path.stat().st_size > 10_000


def test_learning_curve(run: Run, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    assert plot.learning_curve(run) == run.folder / "curve.png"
    assert is_png(run.folder / "curve.png")
    assert is_png(plot.learning_curve(run.metrics, tmp_path / "new" / "other.png", title="by table"))


def test_learning_curve_without_rows(run: Run) -> None:
    pytest.importorskip("matplotlib")
    run.cut(0)
    with pytest.raises(ValueError, match="has no complete iteration to draw: train it first"):
        plot.learning_curve(run)


def test_learning_curve_without_matplotlib(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"needs matplotlib: pip install 'lyceum-warp\[viz\]'"):
        plot.learning_curve(run)


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", autoreset=False, horizon=20)


def still(obs: torch.Tensor) -> torch.Tensor:
    return torch.zeros(len(obs), 2)


def test_episode(env: lw.Env, shared_env: SharedEnv) -> None:
    states = video.episode(env, still, seed=4)
    assert states.shape == (21, env.state_space.size)
    assert torch.equal(states[0, env.state_space.parts["step"]], torch.zeros(1, dtype=torch.float64))
    assert states[-1, env.state_space.parts["time"]].item() == pytest.approx(20 * env.timestep)
    assert torch.equal(states, video.episode(env, still, seed=4))
    with pytest.raises(ValueError, match="one world without automatic resets"):
        video.episode(shared_env("point_mass"), still)


def test_record(env: lw.Env, tmp_path: Path) -> None:
    pytest.importorskip("imageio")
    states = video.episode(env, still, seed=4)
    try:
        path = video.record(env, states, tmp_path / "video.mp4", size=(160, 120))
    except video.NoVideoError as error:
        pytest.skip(str(error))
    # in a small process: imageio forks, which after all other tests may be refused for want of memory
    program = """
import json, sys
import imageio.v2 as imageio
with imageio.get_reader(sys.argv[1]) as reader:
    frames = list(reader.iter_data())
    print(json.dumps([reader.get_meta_data()["fps"], len(frames), frames[0].shape, int(frames[0].max())]))
"""
    done = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True)
    fps, count, shape, brightest = json.loads(done.stdout)
    assert fps == pytest.approx(1 / env.timestep)
    assert count == len(states)
    assert shape == [120, 160, 3]
    assert brightest > 100  # something is lit


def test_a_machine_that_cannot_draw_says_why(env: lw.Env, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(video, "_libraries", lambda: ["nonsense"])
    with pytest.raises(
        video.NoVideoError, match=r"can't draw off-screen \(nonsense: .*\): install Mesa's EGL"
    ) as caught:
        video.record(env, env.get_state(), tmp_path / "video.mp4")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "video.mp4").exists()


def test_the_library_asked_for_is_tried_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setitem(os.environ, "MUJOCO_GL", "osmesa")
    assert video._libraries() == ["osmesa", "egl"]
    monkeypatch.delitem(os.environ, "MUJOCO_GL")
    assert video._libraries() == ["egl", "osmesa"]


def test_video_without_imageio(env: lw.Env, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(video.NoVideoError, match=r"videos need imageio and imageio_ffmpeg: pip install 'lyceum-warp\["):
        video.record(env, env.get_state(), tmp_path / "video.mp4")


def test_video_of_bad_states(env: lw.Env, tmp_path: Path) -> None:
    size = env.state_space.size
    with pytest.raises(ValueError, match=rf"of shape \(steps, {size}\), not \(3, {size - 1}\)"):
        video.record(env, torch.zeros(3, size - 1), tmp_path / "video.mp4")
    with pytest.raises(ValueError, match=r"even numbers, not \(31, 20\)"):
        video.record(env, env.get_state(), tmp_path / "video.mp4", size=(31, 20))


@pytest.mark.parametrize("task, expected", [("half_cheetah", 0), ("hopper", 0), ("reach", 0), ("point_mass", 0)])
def test_the_models_own_camera_is_used(task: str, expected: int) -> None:
    assert camera(mujoco, lw.make(task).model) == expected
