import os
import resource
import shutil
from pathlib import Path

import pytest
from training_runs import QUIET, algorithm, metrics, refused, six_iterations

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.training import Run
from lyceum_warp.training.runs.saving import Saver


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return six_iterations(tmp_path_factory.mktemp("runs") / "six")


def test_run_ends_with_its_last_save_intact_if_a_file_cannot_be_written(six: Path, tmp_path: Path) -> None:
    """A file size limit simulates a full disk. The policy's file fits, but the larger file of the complete state does
    not."""
    folder, limits = tmp_path / "run", resource.getrlimit(resource.RLIMIT_FSIZE)
    size = 2 * os.path.getsize(six / "policy.pt")
    assert size < os.path.getsize(six / "checkpoint.pt")

    def limit(iteration: lw.Iteration) -> None:
        if iteration.iteration == 3:
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))

    try:
        with pytest.raises(OSError) as raised:
            lw.train(algorithm(lw.make("point_mass", nworld=2)), folder, 6, callbacks=[limit], save_every=2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    error = raised.value
    assert error.strerror == "File too large" and error.filename == str(folder / "checkpoint.pt")
    assert error.__notes__ == [f"the run in {folder} is saved up to iteration 2"]
    assert not list(folder.rglob("*.tmp")) and Run.open(folder).read()["iteration"] == 2
    assert cli.main(["train", "--resume", str(folder), "--iterations", "6", *QUIET]) == 0
    assert metrics(folder) == metrics(six)


def test_command_prints_one_line_if_the_folder_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("mine")
    arguments = ["train", "point_mass", "--samples", "512", "--nworld", "2", "--hidden", "8", "--iterations", "4"]
    assert cli.main([*arguments, "--out", str(tmp_path / "file" / "run"), *QUIET]) == 2
    refused(capsys, f"{tmp_path / 'file'}", "Not a directory")
    folder, write = tmp_path / "run", Saver.write

    def deleting(saver: Saver, iteration: lw.Iteration) -> None:
        write(saver, iteration)
        if iteration.iteration == 2:
            shutil.rmtree(folder)

    monkeypatch.setattr(Saver, "write", deleting)
    assert cli.main([*arguments, "--out", str(folder), *QUIET, "--save-every", "100"]) == 2
    refused(capsys, str(folder), "No such file or directory", f"the run in {folder} is saved up to iteration 0")
