import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_task
from training_runs import QUIET, TINY, refused, train

import lyceum_warp as lw
import lyceum_warp.cli.view
from lyceum_warp import cli
from lyceum_warp.training import Configuration, Run, run_env

SOURCE = tiny_task.changed(
    ("@wp.struct", 'if "WITNESS" in os.environ:\n    Path(os.environ["WITNESS"]).touch()\n\n@wp.struct'),
    ("import warp as wp", "import os\nfrom pathlib import Path\n\nimport warp as wp"),
    ("    dt: float", "    dt: float\n    motion: wp.array2d[float] = [[0.0, 1.0]]"),
    ("obs[0] = s.qpos[0]", "obs[0] = s.qpos[0] + p.motion[0, 1]"),
    ("class Tiny", "class Told"),
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trust")
    (folder / "told.py").write_text(SOURCE)
    np.save(folder / "motion.npy", np.zeros((40, 2), dtype=np.float32))
    for name, task, param in (("own", folder / "told.py", f"motion={folder / 'motion.npy'}"),
                              ("named", "point_mass", "success_distance=0.1")):  # fmt: skip
        arguments = ["train", str(task), "--out", str(folder / name), "--param", param, "--horizon", "8", *TINY, *QUIET]
        assert cli.main([*arguments, "--iterations", "1"]) == 0
    return folder


@pytest.fixture
def witness(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("WITNESS", str(tmp_path / "witness"))
    return tmp_path / "witness"


@pytest.fixture
def theirs(made: Path, witness: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copy the run as another user would receive it: at another path, untrusted and without the original files."""
    folder = Path(shutil.copytree(made / "own", tmp_path / "theirs", copy_function=shutil.copy))
    change(folder, task="/home/other/told.py:Told", params={"motion": "/home/other/motion.npy"})
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return folder


def change(folder: Path, **entries: Any) -> None:
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | entries))


def commands(folder: Path, out: Path) -> dict[str, list[str]]:
    return {
        "eval": ["eval", str(folder), "--episodes", "1"],
        "view": ["view", str(folder), "--nworld", "1"],
        "resume": ["train", "--resume", str(folder), "--iterations", "2", *QUIET],
        "from": ["train", "--from", str(folder), "--out", str(out), "--iterations", "1", *QUIET],
    }


@pytest.mark.parametrize("name", ["eval", "view", "resume", "from"])
def test_run_of_another_user_raises_an_error_until_it_is_trusted(
    name: str, theirs: Path, witness: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(lyceum_warp.cli.view, "view", lambda *args, **options: None)
    command = commands(theirs, tmp_path / "out")[name]
    before = {path: path.read_bytes() for path in theirs.rglob("*.*") if path.is_file()}
    capsys.readouterr()
    assert cli.main(command) == 2
    refused(capsys, f"the run in {theirs} was not made by you", f"would run {theirs / 'task' / 'told.py'}", "--trust")
    assert not witness.exists()
    assert before == {path: path.read_bytes() for path in theirs.rglob("*.*") if path.is_file()}
    assert cli.main([*command, "--trust"]) == 0
    assert witness.exists()
    records = {path.read_text().splitlines()[0] for path in (tmp_path / "state").rglob("trusted/*")}
    assert records - {str(tmp_path / "out")} == {str(theirs)}
    shutil.rmtree(tmp_path / "out", ignore_errors=True)
    arguments = [word if word != "2" else "3" for word in command]
    assert cli.main(arguments) == 0
    (theirs / "task" / "told.py").write_text(SOURCE + "\n")
    assert cli.main(command) == 2


@pytest.mark.parametrize(("entries", "kept", "named"), [
    ({"task": "EVIL:Told"}, {}, "EVIL"),
    ({}, {"file": "EVIL"}, "EVIL"),
    ({}, {"file": "../../evil.py"}, "task/../../evil.py"),
    ({}, {"file": "point_mass.py"}, "task/point_mass.py"),
    ({"params": {"motion": "/home/other/table.npy"}}, {}, "/home/other/table.npy"),
    ({"options": {"model": "/home/other/model.xml"}}, {}, "/home/other/model.xml"),
    ({}, {"model": "../model.xml"}, "task/../model.xml"),
])  # fmt: skip
def test_run_with_an_edited_path_raises_an_error(
    entries: dict[str, Any], kept: dict[str, str], named: str, made: Path, witness: Path, tmp_path: Path
) -> None:
    folder, evil = Path(shutil.copytree(made / "named", tmp_path / "named")), tmp_path / "evil.py"
    (folder / "task").mkdir()
    for file in (evil, folder / "task" / "point_mass.py") if "point_mass" in named else [evil]:
        file.write_text(SOURCE)
    entries, kept, named = json.loads(json.dumps([entries, kept, named]).replace("EVIL", str(evil)))
    change(folder, **entries, kept=Run.open(folder).config["kept"] | kept)
    run = Run.open(folder)
    saved = Configuration.of(run)
    for task in (None, "point_mass") if named.startswith("/home") else [None]:
        with pytest.raises(ValueError, match=r"was not made by you .*--trust") as refusal:
            run_env(run, saved.options, saved.params, task=task)
        assert named in str(refusal.value) and not witness.exists()


@pytest.mark.parametrize("link", ["file", "folder"])
def test_link_that_points_outside_the_run_folder_raises_an_error(
    link: str, made: Path, witness: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(made / "own", tmp_path / "own"))
    change(folder, task="/home/other/told.py:Told")
    kept = folder / "task" / "told.py"
    if link == "file":  # the linked file has the same content now, but may be replaced later
        kept.rename(tmp_path / "told.py")
        kept.symlink_to(tmp_path / "told.py")
    else:
        (folder / "task").rename(tmp_path / "task")
        (folder / "task").mkdir()
        (folder / "task" / "inner").symlink_to(tmp_path / "task")
        change(folder, kept=Run.open(folder).config["kept"] | {"file": "inner/told.py"})
    run = Run.open(folder)
    saved = Configuration.of(run)
    with pytest.raises(ValueError, match="was not made by you"):
        run_env(run, saved.options, saved.params)
    assert not witness.exists()


def test_runs_of_this_user_stay_trusted_after_a_move_and_a_task_edit(made: Path, tmp_path: Path) -> None:
    folder, file = tmp_path / "moved", made / "told.py"
    shutil.copytree(made / "own", folder)
    assert cli.main(["eval", str(folder), "--episodes", "1"]) == 0
    file.write_text(SOURCE.replace("qpos[0] + ", "qpos[0] - "))
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


def test_training_continues_if_the_run_cannot_be_added_to_trusted_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    Run.create(tmp_path / "run", {"task": "mine.py"}, files={"mine.py": b""})
    (line,) = caplog.messages
    assert f"need --trust for the run in {tmp_path / 'run'}" in line
