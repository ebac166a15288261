import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import tiny_task
from training_runs import QUIET, TINY, env_of, refused, train

import lyceum_warp as lw
import lyceum_warp.cli.view
from lyceum_warp import cli
from lyceum_warp.training import Run

SOURCE = tiny_task.changed(
    ("@wp.struct", 'if "WITNESS" in os.environ:\n    Path(os.environ["WITNESS"]).touch()\n\n@wp.struct'),
    ("import warp as wp", "import os\nfrom pathlib import Path\n\nimport warp as wp"),
    ("class Tiny", "class Told"),
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trust")
    (folder / "told.py").write_text(SOURCE)
    for name, task in (("own", str(folder / "told.py")), ("named", "point_mass")):
        arguments = ["train", task, "--out", str(folder / name), "--horizon", "8", *TINY, *QUIET]
        assert cli.main([*arguments, "--iterations", "1"]) == 0
    return folder


@pytest.fixture
def witness(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("WITNESS", str(tmp_path / "witness"))
    return tmp_path / "witness"


@pytest.fixture
def theirs(made: Path, witness: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy the run as another user would receive it: at another path, and without the original file."""
    folder = Path(shutil.copytree(made / "own", tmp_path / "theirs", copy_function=shutil.copy))
    change(folder, task="/home/other/told.py:Told")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return folder


def change(folder: Path, **entries: Any) -> None:
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | entries))


@pytest.mark.parametrize("name", ["eval", "view", "resume", "from"])
def test_code_of_another_user_runs_only_if_it_is_named(
    name: str, theirs: Path, witness: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(lyceum_warp.cli.view, "view", lambda *args, **options: None)
    copy = str(theirs / "task" / "told.py")
    more = ["--iterations", "2", *QUIET]
    command, named = {
        "eval": (["eval", str(theirs), "--episodes", "1"], ["--task", copy]),
        "view": (["view", str(theirs), "--nworld", "1"], ["--task", copy]),
        "resume": (["train", "--resume", str(theirs), *more], [copy]),
        "from": (["train", "--from", str(theirs), "--out", str(tmp_path / "out"), *more], [copy]),
    }[name]
    before = {path: path.read_bytes() for path in theirs.rglob("*.*") if path.is_file()}
    capsys.readouterr()
    assert cli.main(command) == 2
    refused(capsys, f"{theirs / 'config.json'} names the task /home/other/told.py:Told", f"--task {copy}:Told")
    assert not witness.exists()
    assert before == {path: path.read_bytes() for path in theirs.rglob("*.*") if path.is_file()}
    assert cli.main([*command, *named]) == 0
    assert witness.exists()
    shutil.rmtree(tmp_path / "out", ignore_errors=True)
    assert cli.main([word if word != "2" else "3" for word in command]) == 0
    Path(copy).write_text(SOURCE + "\n")
    assert cli.main(command) == 2


@pytest.mark.parametrize("file", ["EVIL", "../../evil.py", "point_mass.py"])
def test_run_of_a_task_of_the_package_does_not_run_a_file_that_it_names(
    file: str, made: Path, witness: Path, tmp_path: Path
) -> None:
    folder, evil = Path(shutil.copytree(made / "named", tmp_path / "named")), tmp_path / "evil.py"
    (folder / "task").mkdir()
    for path in (evil, folder / "task" / "point_mass.py"):
        path.write_text(SOURCE)
    change(folder, kept=Run.open(folder).manifest | {"file": file.replace("EVIL", str(evil)), "source_hash": "0"})
    assert env_of(folder).task.name == "point_mass"
    change(folder, task=f"{evil}:Told")
    with pytest.raises(ValueError, match=rf"config\.json names the task {evil}:Told"):
        env_of(folder)
    assert not witness.exists()


@pytest.mark.parametrize("what", ["file", "folder", "module", "linked module"])
def test_added_or_linked_code_makes_a_run_untrusted(what: str, made: Path, witness: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(made / "own", tmp_path / "own"))
    task, other = folder / "task", tmp_path / "other"
    if what == "file":  # the linked file has the same content now, but may be replaced later
        (task / "told.py").rename(other)
        (task / "told.py").symlink_to(other)
    elif what == "folder":
        task.rename(other)
        task.mkdir()
        (task / "inner").symlink_to(other)
        change(folder, kept=Run.open(folder).manifest | {"file": "inner/told.py"})
    elif what == "module":
        (task / "os.py").write_text("")
    else:
        other.mkdir()
        (task / "os").symlink_to(other)
    with pytest.raises(ValueError, match=r"config\.json names the task"):
        env_of(folder)
    assert not witness.exists()


def test_runs_of_this_user_stay_trusted_after_a_move_and_a_task_edit(made: Path, tmp_path: Path) -> None:
    folder, file = tmp_path / "moved", made / "told.py"
    shutil.copytree(made / "own", folder)
    assert cli.main(["eval", str(folder), "--episodes", "1"]) == 0
    file.write_text(SOURCE.replace("qpos[0]", "qvel[0]"))
    try:
        assert cli.main(["eval", str(folder), "--episodes", "1"]) == 0
    finally:
        file.write_text(SOURCE)


def test_run_of_a_task_of_the_package_is_used_without_being_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert train(tmp_path / "run", "--iterations", "1", "--horizon", "8") == 0
    assert cli.main(["eval", str(tmp_path / "run"), "--episodes", "1"]) == 0
    assert not (tmp_path / "state").exists()


def test_policy_of_an_untrusted_run_is_loaded_without_its_task(theirs: Path, witness: Path, tmp_path: Path) -> None:
    assert lw.load(theirs).nobs == 1 and lw.load_value(theirs).discount > 0
    assert cli.main(["export", str(theirs), "--to", str(tmp_path / "policy.pt2")]) == 0
    assert not witness.exists() and not (tmp_path / "state").exists()
    assert cli.main(["export", str(theirs), "--task", str(theirs / "task" / "told.py")]) == 0
    assert witness.exists()


def test_training_continues_if_the_run_cannot_be_added_to_trusted_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    Run.create(tmp_path / "run", {"task": "mine.py", "kept": {"file": "mine.py"}}, files={"mine.py": b""})
    (line,) = caplog.messages
    assert f"the run in {tmp_path / 'run'}" in line and str(tmp_path / "file") in line
