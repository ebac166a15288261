"""Videos."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from conftest import SharedEnv

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
    states = video.episode(env, still, seed=4)
    try:
        path = video.write_video(env, states, tmp_path / "video.mp4", size=(160, 120))
    except video.NoVideoError as error:
        pytest.skip(str(error))
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
