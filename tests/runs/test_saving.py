"""What is saved of a run and when, and where it goes if the folder cannot be written."""

import os
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import SharedEnv
from training_runs import QUIET, algorithm, mean_action, metrics, refused, six_iterations

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.runs import saving as keeper
from lyceum_warp.runs.folder import Run
from lyceum_warp.runs.saving import POLICY_SHARE, SHARE, Keeper, NotSavedError


@pytest.fixture
def env(shared_env: SharedEnv) -> lw.Env:
    """Each algorithm continues its random streams, so tests that compare numbers make environments of their own."""
    return shared_env("point_mass", nworld=2)


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return six_iterations(tmp_path_factory.mktemp("runs") / "six")


def test_files_take_a_small_share_of_the_time(env: lw.Env, tmp_path: Path) -> None:
    npg = algorithm(env)
    run = Run.create(tmp_path / "run", {})
    kept = Keeper(run, npg)
    kept.take(npg.state_dict())
    kept.save_boundary()
    assert not kept.due()
    kept._when -= 1.1 * SHARE * kept._seconds
    assert kept.due()
    assert [Keeper(run, npg, save_every=n).due() for n in (1, 2)] == [True, False]
    kept.keep(next(npg), npg.state_dict())
    assert not kept.policy_due()
    kept._policy_when -= 1.1 * POLICY_SHARE * kept._policy_seconds
    assert kept.policy_due()


# folders that cannot be written


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own with a megabyte."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("cannot mount a file system")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def trained_with(folder: Path, at_three: Callable[[], Any], tmp_path: Path) -> str:
    """Train while something happens to the folder after the third iteration; returns the error's message."""

    def callback(iteration: lw.Iteration) -> None:
        if iteration.iteration == 3:
            at_three()

    npg = algorithm(lw.make("point_mass", nworld=2))
    with pytest.raises(NotSavedError) as raised:
        lw.train(npg, folder, iterations=6, callback=callback, save_every=2, keep_every=2)
    message = str(raised.value)
    print(message)
    assert "\n" not in message and message.startswith(f"the run in {folder} could not be saved after iteration 4 (")
    return message


def assert_continues(folder: Path, six: Path) -> None:
    """A run continues to the same numbers."""
    assert cli.main(["train", "--resume", str(folder), "--iterations", "6", *QUIET]) == 0
    assert metrics(folder) == metrics(six)


def rescued_run(message: str) -> Path:
    """The folder that a message names, for the command and for Python."""
    folder = message.rpartition(" the whole run is in ")[2].partition(";")[0]
    assert message.endswith(f"; continue it with train --resume {folder}, or resume=True")
    return Path(folder)


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


def test_a_rescued_run_has_the_rows_that_can_be_read(
    env: lw.Env, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keeper, "KEPT_ROWS", 2)
    npg, run = algorithm(env), Run.create(tmp_path / "run", {})
    kept = Keeper(run, npg)
    for _ in range(4):
        kept.keep(next(npg), None)

    def rescued(name: str) -> list[float | None]:
        folder = kept._copied(tmp_path / name, whole=False)
        assert folder is not None
        return [row["iteration"] for row in Run.open(folder).rows()]

    whole = run.metrics.read_text()
    assert rescued("whole") == [1, 2, 3, 4]
    run.metrics.write_text(whole[:-9])  # a full disk cuts the last row off
    assert rescued("cut") == [1, 2, 3, 4]
    for number, content in enumerate((b"mine\n1\n", b"\xff\n", b"iteration\n1,2\n")):
        run.metrics.write_bytes(content)
        assert rescued(f"other-{number}") == [3, 4]
    shutil.rmtree(run.folder)
    assert rescued("gone") == [3, 4]


def test_a_folder_that_was_deleted_is_written_beside_it(six: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    message = trained_with(folder, lambda: shutil.rmtree(folder), tmp_path)
    rescued = rescued_run(message)
    assert rescued == tmp_path / "run-rescued" and "No such file or directory" in message
    assert not folder.exists()
    assert {path.name for path in rescued.iterdir()} >= {"config.json", "versions.json", "policy.pt", "best.pt"}
    assert_continues(rescued, six)


def test_a_full_disk_leaves_the_last_checkpoint_and_a_copy_elsewhere(
    six: Path, small_disk: Path, temporary: Path, tmp_path: Path
) -> None:
    folder = small_disk / "run"

    def fill() -> None:
        with (small_disk / "other").open("wb", buffering=0) as file, pytest.raises(OSError, match="No space left"):
            while True:
                file.write(b"0" * 512)

    message = trained_with(folder, fill, tmp_path)
    rescued = rescued_run(message)
    assert rescued.parent == temporary and "No space left on device" in message
    assert_continues(rescued, six)
    assert not list(folder.rglob("*.tmp")) and not (small_disk / "run-rescued").exists()
    (small_disk / "other").unlink()
    assert Run.open(folder).read()["iteration"] == 2
    assert_continues(folder, six)


def test_a_folder_that_becomes_read_only_is_written_elsewhere(
    six: Path, small_disk: Path, temporary: Path, tmp_path: Path
) -> None:
    folder = small_disk / "run"

    def protect() -> None:
        subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)

    message = trained_with(folder, protect, tmp_path)
    assert "Read-only file system" in message
    assert_continues(rescued_run(message), six)
    with pytest.raises(OSError, match="Read-only file system"):
        lw.train(algorithm(lw.make("point_mass", nworld=2)), small_disk / "another", iterations=1)


def test_a_run_that_cannot_be_written_anywhere_leaves_the_last_checkpoint(
    six: Path, temporary: Path, tmp_path: Path
) -> None:
    """No file may grow beyond the policy's size: the policy is saved, the complete state is not."""
    folder, limits = tmp_path / "run", resource.getrlimit(resource.RLIMIT_FSIZE)
    size = 2 * os.path.getsize(six / "policy.pt")
    assert size < os.path.getsize(six / "checkpoint.pt")
    try:
        message = trained_with(folder, lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1])), tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "File too large" in message
    assert message.endswith(f"; {folder} can be continued from iteration 2")
    policy = tmp_path / "run-rescued" / "policy.pt"
    assert f"its policy is in {policy}" in message
    assert torch.equal(mean_action(lw.load(policy)), mean_action(lw.load(six, which=4)))
    assert_continues(folder, six)


def test_a_command_reports_a_folder_that_cannot_be_written_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("mine")
    arguments = ["train", "point_mass", "--samples", "512", "--nworld", "2", "--hidden", "8", "--iterations", "4"]
    assert cli.main([*arguments, "--out", str(tmp_path / "file" / "run"), *QUIET]) == 2
    refused(capsys, f"{tmp_path / 'file'}", "Not a directory")
    folder = tmp_path / "run"
    write = Run.write

    def deleting(run: Run, row: Any) -> None:
        write(run, row)
        if row["iteration"] == 2 and run.folder == folder:
            shutil.rmtree(folder)

    monkeypatch.setattr(Run, "write", deleting)
    assert cli.main([*arguments, "--out", str(folder), *QUIET]) == 2
    refused(capsys, f"the run in {folder} could not be saved after iteration", f"--resume {folder}-rescued")
