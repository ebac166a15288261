import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from headless_screen import state_of
from varied_task import ball

import lyceum_warp as lw
from lyceum_warp.viz import FreeCamera, Shot, new_figure, renderer, video
from lyceum_warp.viz.cameras import camera_values

SMALL = (96, 64)

# imageio forks, and a fork of this process may be too large, so a subprocess reads the video
READ = """
import json, sys
import imageio.v2 as imageio
with imageio.get_reader(sys.argv[1]) as reader:
    frames = list(reader.iter_data())
    result = {"fps": reader.get_meta_data()["fps"], "shape": frames[0].shape, "frames": len(frames)}
    result["brightest"] = [int(frame.max()) for frame in frames]
    result["red"] = [int((frame[..., 0] > frame[..., 1].astype(int) + 60).sum()) for frame in frames]
    result["columns"] = [
        float((frame[..., 0] > frame[..., 1].astype(int) + 60).nonzero()[1].mean()) if red else None
        for frame, red in zip(frames, result["red"])
    ]
    print(json.dumps(result))
"""


def frames_of(path: Path) -> dict[str, Any]:
    """Run READ on a video, and return the statistics that it prints."""
    done = subprocess.run([sys.executable, "-c", READ, str(path)], capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout))


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", autoreset=False, horizon=20)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return ball().compile()


@pytest.fixture(scope="module")
def can_render(model: mujoco.MjModel) -> None:
    try:
        with renderer.Renderer(model, camera={}, size=SMALL):
            pass
    except video.NoVideoError as error:
        pytest.skip(str(error))


def episode(env: lw.Env, seed: int) -> torch.Tensor:
    return lw.control(env, lambda state, obs: torch.zeros(env.action_space.size), seed=seed).states


@pytest.mark.usefixtures("can_render")
def test_write_video_writes_a_frame_for_each_state(env: lw.Env, tmp_path: Path) -> None:
    frames: list[tuple[int, int]] = []
    states, out = episode(env, 4), tmp_path / "new" / "video.mp4"
    video.write_video(env, states, out, size=(160, 120), progress=lambda *counts: frames.append(counts))
    assert frames == [(i, len(states)) for i in range(1, len(states) + 1)]
    assert [file.name for file in out.parent.iterdir()] == ["video.mp4"]
    result = frames_of(out)
    assert result["fps"] == pytest.approx(1 / env.timestep)
    assert result["frames"] == len(states) and result["shape"] == [120, 160, 3]
    assert min(result["brightest"]) > 100  # the scene has light


@pytest.mark.usefixtures("can_render")
def test_video_is_rendered_from_the_given_camera(env: lw.Env, tmp_path: Path) -> None:
    near, far = (
        video.write_video(env, env.get_state(), tmp_path / "video.mp4", camera=camera, size=SMALL).read_bytes()
        for camera in (FreeCamera(distance=0.3), FreeCamera(distance=3.0))
    )
    assert near != far


def test_error_on_a_machine_that_cannot_render_names_a_fix(
    env: lw.Env, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(renderer, "backends", lambda: ["nonsense"])
    message = r"cannot render off-screen \(nonsense: .*\): install Mesa's EGL"
    with pytest.raises(video.NoVideoError, match=message) as caught:
        video.write_video(env, env.get_state(), tmp_path / "video.mp4")
    assert "\n" not in str(caught.value)
    mp4 = video_of(env.model, tmp_path / "video.mp4")
    with pytest.raises(video.NoVideoError, match=message):
        mp4.close()
    assert mp4.finished and not list(tmp_path.iterdir())


@pytest.mark.parametrize("options, message", [
    ({"size": (31, 20)}, r"size must be two even numbers, .*, not \(31, 20\)"),
    ({"speed": 0.0}, r"speed must be a positive number of simulated seconds per second, not 0.0"),
    ({"out": "video.avi"}, r"give a file's name that ends in .mp4, not '.*video.avi'"),
])  # fmt: skip
def test_invalid_video_argument_raises_an_error(
    env: lw.Env, tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    out = tmp_path / options.pop("out", "video.mp4")
    with pytest.raises(ValueError, match=message):
        video.write_video(env, env.get_state(), out, **options)
    assert not list(tmp_path.iterdir())


# single shots


def shot(x: float, **changes: Any) -> Shot:
    model = ball().compile()
    data = mujoco.MjData(model)
    data.qpos[0] = x
    values: dict[str, Any] = dict(state=state_of(model, data), model_fields={}, ghosts=[], lines=[], frames=1)
    return Shot(**values | changes)


def video_of(model: mujoco.MjModel, out: Path, *, fps: float = 30.0, most_waiting: int = 1000) -> video.Recorder:
    return video.Recorder(model, out, camera=camera_values(model), size=SMALL, fps=fps, most_waiting=most_waiting)


@pytest.mark.usefixtures("can_render")
def test_shots_of_a_video_may_have_ghosts_lines_and_different_model_fields(
    model: mujoco.MjModel, tmp_path: Path
) -> None:
    small, red = {"geom_size": np.array([[0.1, 0, 0], [0.1, 0, 0]])}, (1.0, 0.0, 0.0, 1.0)
    usual = {"geom_size": model.geom_size.copy()}
    mp4 = video_of(model, tmp_path / "video.mp4", fps=25)
    for each in (
        shot(0.0), shot(0.0, model_fields=small), shot(0.0, model_fields=usual), shot(0.5),
        shot(0.0, ghosts=[(shot(1.5)["state"], red, (0.0, 0.0))]),
        shot(0.0, lines=[(np.array([[-1.5, 0, -1], [1.5, 0, -1]]), red, 2.0)]),
    ):  # fmt: skip
        mp4.add(each)
    assert mp4.added == 6 and not mp4.finished  # adding a shot does not wait for the render process
    result = frames_of(mp4.close())
    assert (result["frames"], result["fps"], result["shape"]) == (6, 25, [64, 96, 3])
    plain, shrunk, again, _, ghost, line = result["red"]
    assert shrunk < 0.3 * plain and again == pytest.approx(plain, rel=0.05)
    assert ghost > 1.5 * plain and line > plain + 20
    assert result["columns"][3] > result["columns"][2] + 0.5


@pytest.mark.usefixtures("can_render")
def test_slow_rendering_drops_shots_but_keeps_the_video_length(model: mujoco.MjModel, tmp_path: Path) -> None:
    mp4 = video_of(model, tmp_path / "video.mp4", most_waiting=2)
    for i in range(10):
        mp4.add(shot(0.1 * i))
    assert mp4.added == 10 and mp4.dropped in (7, 8)  # the render process may already have taken a shot
    result = frames_of(mp4.close())
    assert result["frames"] == 10
    columns = result["columns"]
    assert columns[1] > columns[0] + 0.5 and columns[-1] == pytest.approx(columns[-2], abs=0.3)


def test_cancelled_or_empty_video_does_not_replace_the_old_file(model: mujoco.MjModel, tmp_path: Path) -> None:
    out = tmp_path / "video.mp4"
    out.write_text("old")
    mp4 = video_of(model, out)
    mp4.add(shot(0.0))
    mp4.cancel()
    with pytest.raises(video.NoVideoError, match="video.mp4 was cancelled"):
        mp4.close()
    with pytest.raises(video.NoVideoError, match="has no frame|cannot render"):
        video_of(model, out).close()
    assert out.read_text() == "old" and [file.name for file in tmp_path.iterdir()] == ["video.mp4"]


@pytest.mark.long
@pytest.mark.usefixtures("can_render")
def test_killed_program_leaves_no_video_file(tmp_path: Path) -> None:
    program = """
import sys, time, mujoco
from lyceum_warp.viz.renderer import Renderer
with Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), sys.argv[1], camera={}, size=(96, 64), fps=30):
    print("ready", flush=True)
    time.sleep(60)
"""
    folder, out = tmp_path / "temporary", tmp_path / "video.mp4"
    folder.mkdir()
    command, environment = [sys.executable, "-c", program, str(out)], os.environ | {"TMPDIR": str(folder)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        process.send_signal(signal.SIGKILL)
    end = time.monotonic() + 30
    while list(folder.iterdir()) and time.monotonic() < end:
        time.sleep(0.05)
    assert not list(folder.iterdir()) and not out.exists()


def test_error_names_the_extra_if_matplotlib_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"needs matplotlib: pip install 'lyceum-warp\[viz\]'"):
        new_figure("curves", 1.0, 1.0)
