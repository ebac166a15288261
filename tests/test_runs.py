"""The folder of a run: creation, table, checkpoint, and what is refused."""

import csv
import json
import resource
from pathlib import Path

import pytest
import torch

from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.runs import FORMAT, Run, load


@pytest.fixture
def run(tmp_path: Path) -> Run:
    run = Run.create(tmp_path / "run", {"task": "hopper", "seed": 0, "scale": float("inf")})
    run.save(0, GaussianPolicy(3, 2, (8, 4), normalize=True), {"counter": 5, "tensor": torch.arange(3)})
    return run


def test_open_returns_the_configuration(run: Run) -> None:
    assert Run.open(run.folder).config == {"format": FORMAT, "task": "hopper", "seed": 0, "scale": float("inf")}


def test_create_writes_the_versions(run: Run) -> None:
    versions = json.loads((run.folder / "versions.json").read_text())
    assert versions["torch"] == torch.__version__
    packages = {"lyceum_warp", "mujoco", "mujoco_warp", "warp_lang", "numpy"}
    assert packages | {"python", "platform", "cpu"} <= versions.keys()


def test_read_returns_the_saved_state(run: Run) -> None:
    state = Run.open(run.folder).read()["state"]
    assert state["counter"] == 5
    assert state["tensor"].tolist() == [0, 1, 2]
    assert {path.name for path in run.folder.iterdir()} == {"config.json", "versions.json", "checkpoint.pt"}


def test_create_refuses_a_folder_with_content(run: Run, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in run.folder.iterdir()}
    with pytest.raises(ValueError, match=r"holds a run: continue it with resume=True, or give another folder"):
        Run.create(run.folder, {})
    assert before == {path: path.read_bytes() for path in run.folder.iterdir()}
    (tmp_path / "file").write_text("mine")
    for place in (tmp_path, tmp_path / "file"):
        with pytest.raises(ValueError, match="is not an empty folder: give another folder"):
            Run.create(place, {})


def test_create_leaves_no_folder_when_the_configuration_is_bad(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        Run.create(tmp_path / "run", {"task": object()})
    assert not (tmp_path / "run").exists()


def test_open_of_an_empty_folder_finds_no_run(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no run in .*: it has no config\.json"):
        Run.open(tmp_path)


def test_open_refuses_a_foreign_configuration(tmp_path: Path) -> None:
    for text in ("{", "[]", "{}", '"text"'):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(ValueError, match=r"config\.json is not the configuration of a run"):
            Run.open(tmp_path)
    (tmp_path / "config.json").write_text('{"format": "one"}')
    with pytest.raises(ValueError, match="was not written by lyceum_warp: its format is 'one'"):
        Run.open(tmp_path)


def test_open_refuses_a_run_of_a_newer_release(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"format": FORMAT + 1}))
    with pytest.raises(ValueError, match=r"newer lyceum_warp \(format 2, this one reads up to 1\): pip install --up"):
        Run.open(tmp_path)


def test_a_new_column_is_empty_in_earlier_rows(run: Run) -> None:
    """As after an update of the task, or of the package; the order of a row's names does not matter."""
    run.write({"iteration": 1, "kl": 0.5})
    run.write({"iteration": 2, "kl": None, "metrics/forward, m": 1.5})
    run.write({"metrics/forward, m": 2.5, "iteration": 3})
    assert run.rows() == [
        {"iteration": 1, "kl": 0.5, "metrics/forward, m": None},
        {"iteration": 2, "kl": None, "metrics/forward, m": 1.5},
        {"iteration": 3, "kl": None, "metrics/forward, m": 2.5},
    ]


def test_rows_before_the_first_iteration_are_missing(run: Run) -> None:
    with pytest.raises(FileNotFoundError, match="the run has no complete iteration"):
        run.rows()


def test_rows_come_back_with_every_digit(run: Run) -> None:
    rows = [{"iteration": i, "value": i / 3, "mean": None if i % 2 else 1e-30, "bad": float("nan")} for i in (1, 2, 3)]
    for row in rows:
        run.write(row)
    with run.metrics.open(newline="") as file:
        table = list(csv.reader(file))
    assert table[0] == ["iteration", "value", "mean", "bad"]
    assert table[1] == ["1", repr(1 / 3), "", "nan"]
    read = run.rows()
    assert [row["value"] for row in read] == [row["value"] for row in rows]
    assert [row["mean"] for row in read] == [None, 1e-30, None]


def test_cut_counts_iterations_and_not_rows(run: Run) -> None:
    for i in (4, 5, 6):
        run.write({"value": 0.5, "iteration": i})
    run.cut(5)
    assert [row["iteration"] for row in run.rows()] == [4, 5]


def test_cut_drops_rows_without_a_checkpoint(run: Run) -> None:
    run.cut(2)  # without a table
    for i in (1, 2, 3):
        run.write({"iteration": i, "value": 0.5})
    with run.metrics.open("a") as file:
        file.write("4,0.")  # a row that was cut off when the process ended
    whole = run.metrics.read_text()
    run.cut(2)
    assert [row["iteration"] for row in run.rows()] == [1, 2]
    run.metrics.write_text(whole)
    run.cut(9)
    assert [row["iteration"] for row in run.rows()] == [1, 2, 3]
    run.cut(0)
    run.write({"iteration": 1, "value": 0.5})
    assert [row["iteration"] for row in run.rows()] == [1]


def test_a_table_of_another_kind_is_refused(run: Run) -> None:
    run.metrics.write_text("iteration,value\n1,apple\n")
    with pytest.raises(ValueError, match=r"metrics\.csv is not a table of metrics: line 2"):
        run.rows()
    run.metrics.write_text("iteration,value\n1,2,3\n")
    with pytest.raises(ValueError, match="line 2"):
        run.rows()


def test_load_returns_the_same_policy(run: Run) -> None:
    policy = GaussianPolicy(3, 2, (8, 4), normalize=True)
    policy.normalizer.update(3.0 + 2.0 * torch.randn(100, 3))  # type: ignore[operator]
    run.save(1, policy, {})
    for given in (run, run.folder, str(run.folder), run.checkpoint):
        loaded = load(given)
        obs = torch.randn(5, 3)
        assert torch.equal(loaded(obs), policy(obs))
        assert not loaded.training
        assert not loaded(obs).requires_grad


def test_a_failed_save_keeps_the_old_checkpoint(run: Run) -> None:
    """As on a full disk: no file may grow beyond half of the checkpoint."""
    before, limits = run.checkpoint.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            run.save(1, GaussianPolicy(3, 2), {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert run.checkpoint.read_bytes() == before
    assert not list(run.folder.glob("*.tmp"))


def test_a_checkpoint_keeps_the_one_before_it(run: Run, caplog: pytest.LogCaptureFixture) -> None:
    run.save(1, GaussianPolicy(3, 2), {"counter": 6})
    assert run.read()["iteration"] == 1
    run.checkpoint.write_bytes(b"PK half")
    assert run.read()["iteration"] == 0 and f"{run.previous}, of iteration 0, is used instead" in caplog.text
    run.checkpoint.unlink()
    assert run.read()["iteration"] == 0
    run.previous.write_bytes(b"PK half")
    with pytest.raises(FileNotFoundError, match=r"there is no checkpoint .*checkpoint\.pt"):
        run.read()


class Foreign:
    """A class whose instances a checkpoint must not contain."""


@pytest.mark.parametrize("kind", ["empty", "truncated", "text", "foreign", "code", "list", "newer", "partial", "shape"])
def test_broken_and_foreign_checkpoints_are_refused_in_one_line(run: Run, kind: str) -> None:
    path, whole = run.checkpoint, run.checkpoint.read_bytes()
    content = run.read()
    fix = "restore the file from a copy, or train again with another --out"
    match kind:
        case "empty":
            path.write_bytes(b"")
        case "truncated":
            path.write_bytes(whole[: len(whole) // 2])
        case "text":
            path.write_text("weights: 1, 2, 3\n")
        case "foreign":
            torch.save({"model": torch.zeros(2)}, path)
        case "code":
            torch.save({"lyceum_warp": FORMAT, "policy": Foreign()}, path)
        case "list":
            torch.save([1, 2], path)
        case "newer":
            torch.save(content | {"lyceum_warp": FORMAT + 1}, path)
            fix = "pip install --upgrade lyceum-warp"
        case "partial":
            del content["policy"]
            torch.save(content, path)
        case "shape":
            content["policy"]["shape"]["nobs"] = 4
            torch.save(content, path)
    with pytest.raises(ValueError, match=fix) as caught:
        load(run)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_checkpoint_is_reported(run: Run) -> None:
    run.checkpoint.unlink()
    with pytest.raises(FileNotFoundError, match=r"there is no checkpoint .*checkpoint\.pt: train the run first"):
        load(run)


def test_changed_versions_are_returned_and_noted(run: Run) -> None:
    now = json.loads((run.folder / "versions.json").read_text())
    assert run.changed(now) == {}
    assert run.changed(now | {"torch": "9.9"}) == {"torch": (torch.__version__, "9.9")}
    assert json.loads((run.folder / "versions.json").read_text())["resumed"] == [{"torch": "9.9"}]
