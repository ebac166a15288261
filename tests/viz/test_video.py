"""Videos."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import SharedEnv
from varied_task import Varied

import lyceum_warp as lw
from lyceum_warp.viz import video


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", autoreset=False, horizon=20)


def still(obs: torch.Tensor) -> torch.Tensor:
    return torch.zeros(len(obs), 2)


def test_episode_returns_all_states(env: lw.Env) -> None:
    states = video.episode(env, still, seed=4)
    assert states.shape == (21, env.state_space.size)
    assert torch.equal(states[0, env.state_space.parts["step"]], torch.zeros(1, dtype=torch.float64))
    assert states[-1, env.state_space.parts["time"]].item() == pytest.approx(20 * env.timestep)
    assert torch.equal(states, video.episode(env, still, seed=4))


def test_episode_refuses_automatic_resets(shared_env: SharedEnv) -> None:
    with pytest.raises(ValueError, match="one world without automatic resets"):
        video.episode(shared_env("point_mass"), still)


def test_write_video_writes_a_frame_for_each_state(env: lw.Env, tmp_path: Path) -> None:
    pytest.importorskip("imageio")
    steps: list[tuple[int, int]] = []
    frames: list[tuple[int, int]] = []
    states = video.episode(env, still, seed=4, progress=lambda *counts: steps.append(counts))
    assert steps == [(10, 20), (20, 20)]
    progress = lambda *counts: frames.append(counts)  # noqa: E731
    try:
        path = video.write_video(env, states, tmp_path / "video.mp4", size=(160, 120), progress=progress)
    except video.NoVideoError as error:
        pytest.skip(str(error))
    assert frames == [(i, len(states)) for i in range(1, len(states) + 1)]
    # in a small process: imageio forks, and after all other tests there may be too little memory to fork this one
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
    assert brightest > 100  # the scene has light


def test_a_video_has_the_model_fields_of_its_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("imageio")
    env = lw.make(Varied, autoreset=False)
    first, second = (video.episode(env, lambda obs: torch.zeros(1, 1), seed=seed) for seed in (1, 2))
    states, parts = torch.cat([first, second]), env.state_space.parts
    sizes = states[:, parts["geom_size"]][:, 0]
    assert sizes.unique().numel() == 2
    jobs = []

    def drawn(arguments: list[str], progress: object) -> None:
        with np.load(arguments[0]) as job:
            jobs.append(dict(job))
        Path(arguments[2]).write_bytes(b"")

    with monkeypatch.context() as patch:
        patch.setattr(video, "_draw", drawn)
        video.write_video(env, states, tmp_path / "none.mp4", speed=1e-3)
    for name in ("body_mass", "body_pos", "geom_size"):
        np.testing.assert_array_equal(jobs[0][f"model_{name}"], states[:, parts[name]].numpy())
    try:
        path = video.write_video(env, states, tmp_path / "video.mp4", size=(160, 120), speed=0.01)
    except video.NoVideoError as error:
        pytest.skip(str(error))
    program = """
import json, sys
import imageio.v2 as imageio
with imageio.get_reader(sys.argv[1]) as reader:
    print(json.dumps([int((f[..., 0] > f[..., 1].astype(int) + 60).sum()) for f in reader.iter_data()]))
"""
    done = subprocess.run([sys.executable, "-c", program, str(path)], capture_output=True, text=True, check=True)
    areas = np.array(json.loads(done.stdout), dtype=float)  # of the red ball, which is seen from a fixed place
    assert len(areas) == len(states) and areas.min() > 0
    ratio = areas[len(first) :].mean() / areas[: len(first)].mean()
    assert ratio == pytest.approx((sizes[-1] / sizes[0]).item() ** 2, rel=0.25)


def test_a_machine_that_cannot_draw_is_reported_with_a_fix(
    env: lw.Env, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(video, "_libraries", lambda: ["nonsense"])
    with pytest.raises(
        video.NoVideoError, match=r"cannot draw off-screen \(nonsense: .*\): install Mesa's EGL"
    ) as caught:
        video.write_video(env, env.get_state(), tmp_path / "video.mp4")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "video.mp4").exists()


def test_the_library_in_mujoco_gl_is_tried_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setitem(os.environ, "MUJOCO_GL", "osmesa")
    assert video._libraries() == ["osmesa", "egl"]
    monkeypatch.delitem(os.environ, "MUJOCO_GL")
    assert video._libraries() == ["egl", "osmesa"]


def test_a_missing_imageio_is_reported_with_the_extra(
    env: lw.Env, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(video.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(video.NoVideoError, match=r"videos need imageio and imageio_ffmpeg: pip install 'lyceum-warp\["):
        video.write_video(env, env.get_state(), tmp_path / "video.mp4")


def test_states_of_another_shape_are_refused(env: lw.Env, tmp_path: Path) -> None:
    size = env.state_space.size
    with pytest.raises(ValueError, match=rf"must have the shape \(steps, {size}\), not \(3, {size - 1}\)"):
        video.write_video(env, torch.zeros(3, size - 1), tmp_path / "video.mp4")


def test_an_odd_size_is_refused(env: lw.Env, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"size must be two even numbers, .*, not \(31, 20\)"):
        video.write_video(env, env.get_state(), tmp_path / "video.mp4", size=(31, 20))
