import csv
import shutil
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from memory_window import MemoryWindow
from training_runs import refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.training import Run
from lyceum_warp.viewer import show as views
from lyceum_warp.viewer.protocol import Frame, Scene
from lyceum_warp.viz import change_model

SOURCE = Path(__file__).parents[1]
SMALL = "--algorithm ppo --iterations 2 --nworld 6 --num-steps 40 --minibatches 1 --hidden 8 --value-hidden 8"


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("tasks")
    shutil.copy(SOURCE / "object_task.py", folder / "falling.py")
    (folder / "data").mkdir()
    shutil.copy(SOURCE / "data" / "wedge.obj", folder / "data")
    return f"{folder / 'falling.py'}:Drop"


def test_run_with_chosen_objects_is_evaluated_object_by_object(
    task: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert cli.main(["train", task, "--objects", "wedge,ball", "--out", str(out), *SMALL.split()]) == 0
    assert Run.open(out).config["options"]["objects"] == ["wedge", "ball"]
    assert (out / "task" / "data" / "wedge.obj").is_file()
    *_, row = csv.DictReader((out / "metrics.csv").open())  # no episode ends in the first iteration
    assert (float(row["metrics/success/wedge"]), float(row["metrics/success/ball"])) == (0.0, 1.0)
    capsys.readouterr()
    assert cli.main(["eval", str(out), "--episodes", "4", "--nworld", "2"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert [line[:3] for line in lines if line and line[0] in ("wedge", "ball")] == [
        ["wedge", "2", "0"], ["ball", "2", "1"]
    ]  # fmt: skip
    assert cli.main(["eval", str(out), "--objects", "bal"]) == 2
    refused(capsys, "'bal'", "did you mean ball?")


def test_view_shows_the_chosen_object(task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenes: list[Scene] = []
    frames: list[Frame] = []

    def open_window(scene: Scene, **options: Any) -> MemoryWindow:
        scenes.append(scene)
        return MemoryWindow(lambda frame, number: frames.append(frame))

    monkeypatch.setattr(views, "Window", open_window)
    assert cli.main(["view", task, "--objects", "wedge,ball", "--nworld", "2"]) == 0
    (tmp_path / "model.mjb").write_bytes(scenes[0].model)
    model = mujoco.MjModel.from_binary_path(str(tmp_path / "model.mjb"))
    env = lw.make(task, objects=["wedge", "ball"], nworld=2)
    ball = env.state_space.split(env.get_state()[1])
    for fields, visible in (
        (frames[0].model_fields, [False, True]),  # the sphere and the mesh
        ({name: ball[name].numpy() for name in frames[0].model_fields}, [True, False]),
    ):
        change_model(mujoco, model, fields)
        first = model.body("object").geomadr[0]
        assert (model.geom_rgba[first : first + 2, 3] > 0).tolist() == visible
    assert model.body("object").mass == pytest.approx(4 / 3 * np.pi * 0.05**3 * 1000)
