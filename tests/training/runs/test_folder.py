import csv
import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from training_runs import QUIET, algorithm, refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.algos import GaussianPolicy
from lyceum_warp.training import Run, load
from lyceum_warp.training.runs.checkpoints import FORMAT, policy_content as content


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Run.create(tmp_path / "run", {"task": "hopper", "seed": 0, "scale": float("inf")})
    run.save(content(0, GaussianPolicy(3, 2, (8, 4), normalize=True)), {"counter": 5, "tensor": torch.arange(3)})
    return run


def test_new_run_folder_contains_the_package_versions(run: Run) -> None:
    versions = Run.open(run.folder).config["versions"]
    assert versions["torch"] == torch.__version__
    packages = {"lyceum_warp", "mujoco", "mujoco_warp", "warp_lang", "numpy"}
    assert packages | {"python", "platform", "cpu"} <= versions.keys()


@pytest.mark.parametrize(
    ("config", "name"),
    [({"task": "dm/walker_walk"}, "dm/walker_walk"), ({"task": "a/mine.py:Mine"}, "mine"),
     ({"task": "a/mine.py:Mine", "kept": {"name": "other"}}, "other")],
)  # fmt: skip
def test_run_has_the_name_of_its_task(tmp_path: Path, config: dict[str, object], name: str) -> None:
    assert Run.create(tmp_path / "run", config).task_name == name


def test_creating_a_run_in_a_folder_with_content_raises_an_error(run: Run, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in run.folder.iterdir()}
    with pytest.raises(ValueError, match=f"{run.folder} contains a run"):
        Run.create(run.folder, {})
    assert before == {path: path.read_bytes() for path in run.folder.iterdir()}
    for file in ("file", "other/mine.tmp"):  # temporary files may belong to another program
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).write_text("mine")
    for place in (tmp_path, tmp_path / "file", tmp_path / "other"):
        with pytest.raises(ValueError, match=f"{place} exists"):
            Run.create(place, {})


def test_creating_a_run_with_an_invalid_configuration_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        Run.create(tmp_path / "run", {"task": object()})
    assert not (tmp_path / "run").exists()


def test_run_is_created_over_the_remains_of_a_killed_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(path: Path, text: str) -> None:
        path.write_bytes(text[:9].encode())
        os.kill(os.getpid(), signal.SIGKILL)

    folder = tmp_path / "run"
    if (child := os.fork()) == 0:
        monkeypatch.setattr(Path, "write_text", killed)
        try:
            Run.create(folder, {}, files={"old.py": b"old"})
        finally:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == signal.SIGKILL
    assert list(folder.iterdir())
    run = Run.create(folder, {"task": "mine.py"}, files={"mine.py": b"new"})
    assert sorted(path.name for path in folder.iterdir()) == ["config.json", "task"]
    assert [path.name for path in run.task_folder.iterdir()] == ["mine.py"]


def test_loaded_policy_equals_the_saved_policy(run: Run) -> None:
    policy = GaussianPolicy(3, 2, (8, 4), normalize=True)
    policy.normalizer.update(3.0 + 2.0 * torch.randn(100, 3))  # type: ignore[operator]
    run.save(content(1, policy), {})
    for given in (run, run.folder, str(run.folder), run.checkpoint):
        loaded = load(given)
        obs = torch.randn(5, 3)
        assert torch.equal(loaded(obs), policy(obs))
        assert not loaded.training
        assert not loaded(obs).requires_grad


def test_previous_checkpoint_remains_after_a_save(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    run.save(content(1, GaussianPolicy(3, 2)), {"counter": 6})
    assert run.read()["iteration"] == 1
    run.checkpoint.write_bytes(b"PK half")
    assert run.read()["iteration"] == 0 and f"{run.previous}, of iteration 0, is used instead" in caplog.text
    run.checkpoint.unlink()
    assert run.read()["iteration"] == 0
    run.previous.write_bytes(b"PK half")
    with pytest.raises(FileNotFoundError, match=r"there is no checkpoint .*checkpoint\.pt"):
        run.read()


# config.json


@pytest.mark.parametrize(("config", "text"), [
    *((config, "") for config in ("{", [], {}, "text")),
    *(({"format": number}, repr(number)) for number in (FORMAT + 1, "one")),
    ({"planner": {}}, "planner"), ({"task": 3}, "task .*3"), ({"kept": []}, r"kept .*\[\]"),
    ({"kept": {"file": 3}}, "file .*3"), ({"params": None}, "params .*None"), ({"seed": 2**63}, f"seed .*{2**63}"),
    ({"nworld": True}, "nworld .*True"), ({"tensorboard": 1}, "tensorboard .*1"),
    ({"reached": {"iteration": 1, "return": None}}, "return .*None"),
    ({"algorithm": "mine", "mine": 3}, "mine .*3"), ({"algorithm": "npg", "npg_seed": -1}, "npg_seed .*-1"),
])  # fmt: skip
def test_error_of_an_invalid_configuration_names_the_file(config: Any, text: str, tmp_path: Path) -> None:
    if isinstance(config, dict) and config:
        config = {"format": FORMAT} | config
    (tmp_path / "config.json").write_text(config if config == "{" else json.dumps(config))
    with pytest.raises(ValueError, match=rf"{tmp_path}/config\.json .*{text}"):
        Run.open(tmp_path)


def test_path_without_a_run_names_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("runs/hopper-1", "runs/hopper-2"):
        Run.create(tmp_path / name, {}).policy.touch()
    for path, text in [
        ("runs/hoper-1", f"{tmp_path}/runs/hopper-1 or {tmp_path}/runs/hopper-2?"),
        ("nothing", f"{tmp_path}/nothing"),
        ("runs", f"{tmp_path}/runs/hopper-2"),
        ("runs/hopper-2/policy.pt", "is a file"),
    ]:
        for command in ("export", "view", "eval"):
            assert cli.main([command, str(tmp_path / path)]) == 2
            refused(capsys, text)


def test_error_of_an_invalid_setting_names_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = lw.train(algorithm(lw.make("point_mass", nworld=2)), tmp_path / "run", 1)
    run.amend(engine="x")
    assert cli.main(["train", "--resume", str(run.folder), "--iterations", "2", *QUIET]) == 2
    refused(capsys, "'x'", f"with the settings in {run.folder / 'config.json'}")


# metrics.csv


def test_a_new_column_of_metrics_is_empty_in_earlier_rows(tmp_path: Path) -> None:
    run = Run(tmp_path, {})
    run.append({"iteration": 1, "kl": 0.5})
    run.append({"iteration": 2, "kl": None, "metrics/forward, m": 1.5})
    run.append({"metrics/forward, m": 2.5, "iteration": 3})
    assert run.rows() == [
        {"iteration": 1, "kl": 0.5, "metrics/forward, m": None},
        {"iteration": 2, "kl": None, "metrics/forward, m": 1.5},
        {"iteration": 3, "kl": None, "metrics/forward, m": 2.5},
    ]


def test_numbers_in_metrics_rows_are_read_exactly(tmp_path: Path) -> None:
    run = Run(tmp_path, {})
    rows = [{"iteration": i, "value": i / 3, "mean": None if i % 2 else 1e-30, "bad": float("nan")} for i in (1, 2, 3)]
    for row in rows:
        run.append(row)
    with run.metrics.open(newline="") as file:
        cells = list(csv.reader(file))
    assert cells[0] == ["iteration", "value", "mean", "bad"]
    assert cells[1] == ["1", repr(1 / 3), "", "nan"]
    read = run.rows()
    assert [row["value"] for row in read] == [row["value"] for row in rows]
    assert [row["mean"] for row in read] == [None, 1e-30, None]


def test_metrics_rows_after_the_checkpoint_are_removed(tmp_path: Path) -> None:
    run = Run(tmp_path, {})
    run.cut(2)  # without a table
    for i in (1, 2, 3):
        run.append({"iteration": i, "value": 0.5})
    with run.metrics.open("a") as file:
        file.write("4,0.")  # an incomplete row
    whole = run.metrics.read_text()
    run.cut(2)
    assert [row["iteration"] for row in run.rows()] == [1, 2]
    run.metrics.write_text(whole)
    run.cut(9)
    assert [row["iteration"] for row in run.rows()] == [1, 2, 3]
    run.cut(0)
    run.append({"iteration": 1, "value": 0.5})
    assert [row["iteration"] for row in run.rows()] == [1]


def test_file_that_is_not_a_metrics_table_raises_an_error(tmp_path: Path) -> None:
    run = Run(tmp_path, {})
    run.metrics.write_text("iteration,value\n1,apple\n")
    with pytest.raises(ValueError, match=r"metrics\.csv .*line 2: .*apple"):
        run.rows()
