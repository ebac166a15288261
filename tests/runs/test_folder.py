import json
import os
import signal
from pathlib import Path

import pytest
import torch

from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.runs.checkpoints import FORMAT
from lyceum_warp.runs.checkpoints import policy_content as content
from lyceum_warp.runs.folder import Run, load


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


def test_run_reads_back_the_saved_state(run: Run) -> None:
    state = Run.open(run.folder).read()["state"]
    assert state["counter"] == 5
    assert state["tensor"].tolist() == [0, 1, 2]
    assert {path.name for path in run.folder.iterdir()} == {"config.json", "policy.pt", "checkpoint.pt"}


@pytest.mark.parametrize(
    ("config", "name"),
    [({"task": "dm/walker_walk"}, "dm/walker_walk"), ({"task": "a/mine.py:Mine"}, "mine"),
     ({"task": "a/mine.py:Mine", "kept": {"name": "other"}}, "other")],
)  # fmt: skip
def test_run_has_the_name_of_its_task(tmp_path: Path, config: dict[str, object], name: str) -> None:
    assert Run.create(tmp_path / "run", config).task_name == name


def test_creating_a_run_in_a_folder_with_content_raises_an_error(run: Run, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in run.folder.iterdir()}
    with pytest.raises(ValueError, match=r"contains a run: use another folder, or continue the run"):
        Run.create(run.folder, {})
    assert before == {path: path.read_bytes() for path in run.folder.iterdir()}
    (tmp_path / "file").write_text("mine")
    for place in (tmp_path, tmp_path / "file"):
        with pytest.raises(ValueError, match="is not an empty folder: use another folder"):
            Run.create(place, {})


def test_creating_a_run_with_an_invalid_configuration_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(TypeError):
        Run.create(tmp_path / "run", {"task": object()})
    assert not (tmp_path / "run").exists()


def test_run_can_be_created_in_a_folder_that_a_killed_process_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_folder_with_temporary_files_of_other_programs_is_not_used(tmp_path: Path) -> None:
    (tmp_path / "mine.tmp").write_text("")
    with pytest.raises(ValueError, match="is not an empty folder"):
        Run.create(tmp_path, {})


def test_opening_an_empty_folder_raises_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no run in .*: it has no config\.json"):
        Run.open(tmp_path)


def test_opening_a_configuration_of_another_program_raises_an_error(tmp_path: Path) -> None:
    for text in ("{", "[]", "{}", '"text"'):
        (tmp_path / "config.json").write_text(text)
        with pytest.raises(ValueError, match=r"config\.json is not the configuration of a run"):
            Run.open(tmp_path)


@pytest.mark.parametrize("number", [FORMAT + 1, "one"])
def test_opening_a_run_of_an_unknown_format_raises_an_error(number: int | str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"format": number}))
    with pytest.raises(
        ValueError, match=rf"has format {number!r}, and .* reads formats up to 1: pip install --upgrade"
    ):
        Run.open(tmp_path)


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
