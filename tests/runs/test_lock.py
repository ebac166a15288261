import contextlib
import json
import os
import platform
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from training_runs import QUIET, algorithm, metrics, refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.runs import lock
from lyceum_warp.runs.lock import RunLock

KILLED = """
import os, sys
from pathlib import Path
from lyceum_warp.runs.lock import RunLock
RunLock(Path(sys.argv[1])).__enter__()
os.kill(os.getpid(), 9)
"""


def held(folder: Path, *, seconds: float = 0.0, **changes: Any) -> None:
    """Write the lock of a running process. The last heartbeat of the lock was the given number of seconds ago."""
    pid = os.getppid()
    owner = {"host": platform.node(), "pid": pid, "started": lock._started(pid), "token": "theirs"}
    (folder / "lock").write_text(json.dumps(owner | changes))
    then = time.time() - seconds
    os.utime(folder / "lock", (then, then))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    lw.train(algorithm(lw.make("point_mass", nworld=2)), tmp_path / "run", iterations=2)
    return tmp_path / "run"


def test_second_writer_raises_an_error_until_the_first_writer_ends(tmp_path: Path) -> None:
    with pytest.raises(KeyError), RunLock(tmp_path):
        line = rf"the run in {tmp_path} is being written by process {os.getpid()} on {platform.node()}: end this"
        with pytest.raises(ValueError, match=line), RunLock(tmp_path):
            pass
        raise KeyError
    assert not list(tmp_path.iterdir())
    with RunLock(tmp_path):
        pass


def test_resuming_a_run_that_another_process_writes_raises_an_error(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held(run)
    before = {path: path.read_bytes() for path in run.iterdir()}
    process = f"process {os.getppid()} on {platform.node()}"
    capsys.readouterr()
    assert cli.main(["train", "--resume", str(run), "--iterations", "4", *QUIET]) == 2
    refused(capsys, f"is being written by {process}", "--take-over")
    npg = algorithm(lw.make("point_mass", nworld=2))
    with pytest.raises(ValueError, match=f"is being written by {process}"):
        lw.train(npg, run, iterations=4, resume=True)
    assert before == {path: path.read_bytes() for path in run.iterdir()}
    assert cli.main(["train", "--resume", str(run), "--iterations", "4", "--take-over", *QUIET]) == 0
    refused(capsys, f"the run in {run} is taken over from {process}, on request")
    assert len(metrics(run)) == 4 and not (run / "lock").exists()


def test_flag_take_over_prints_an_error_if_the_flag_resume_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["train", "point_mass", "--take-over", "--out", str(tmp_path / "run")]) == 2
    refused(capsys, "--take-over has no effect without --resume")


def test_lock_of_a_killed_process_is_taken_over(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    killed = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)])
    killed.wait(60)
    with RunLock(tmp_path):
        assert json.loads((tmp_path / "lock").read_text())["pid"] == os.getpid()
    gone = f"the run in {tmp_path} is taken over from process {killed.pid} on {platform.node()}, which is gone"
    assert caplog.messages == [gone]


def test_lock_is_free_if_its_pid_belongs_to_a_later_process(tmp_path: Path) -> None:
    held(tmp_path, started="1")
    with RunLock(tmp_path):
        pass


def test_a_lock_without_a_heartbeat_is_taken_over(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    held(tmp_path, seconds=60.0)
    with pytest.raises(ValueError, match="is being written"), RunLock(tmp_path):
        pass
    held(tmp_path, seconds=180.0)
    with RunLock(tmp_path):
        assert "which has been silent for 180 s" in caplog.text


def test_a_held_lock_gets_a_heartbeat(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "BEAT", 0.01)
    with RunLock(tmp_path):
        os.utime(tmp_path / "lock", (0.0, 0.0))
        end = time.monotonic() + 30.0
        while (tmp_path / "lock").stat().st_mtime < time.time() - 60.0:
            assert time.monotonic() < end
            time.sleep(0.01)


@pytest.mark.parametrize("content", ["host", "damaged"])
def test_lock_of_another_host_is_taken_over_only_with_the_flag_take_over(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The age of the lock does not matter, because the clocks of two hosts may differ."""
    held(tmp_path, seconds=1e6)
    if content == "damaged":
        (tmp_path / "lock").write_text("half a li")
        who = "another process"
    else:
        who = f"process {os.getppid()} on {platform.node()}"
        monkeypatch.setattr(platform, "node", lambda: "far")
    with pytest.raises(ValueError, match=f"is being written by {who}"), RunLock(tmp_path):
        pass
    notes: list[str] = []
    with RunLock(tmp_path, take_over=True, note=notes.append):
        pass
    assert notes == [f"the run in {tmp_path} is taken over from {who}, on request"]


def test_writer_stops_writing_after_its_lock_was_taken_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At its end, the old writer does not remove the lock of the new writer."""
    folder, found, takers = tmp_path / "run", {}, []

    def callback(iteration: lw.Iteration) -> None:
        if iteration.iteration == 2:
            with monkeypatch.context() as patched:
                patched.setattr(platform, "node", lambda: "far")
                takers.append(RunLock(folder, take_over=True).__enter__())
            found.update({path: path.read_bytes() for path in folder.rglob("*.*")})

    with pytest.raises(ValueError, match=f"the run in {folder} was taken over by process {os.getpid()} on far"):
        lw.train(algorithm(lw.make("point_mass", nworld=2)), folder, iterations=6, save_every=1, callback=callback)
    assert found == {path: path.read_bytes() for path in folder.rglob("*.*")}
    assert json.loads((folder / "lock").read_text())["host"] == "far"
    takers[0].__exit__()


def test_only_one_of_many_writers_gets_a_free_lock(tmp_path: Path) -> None:
    for _ in range(20):
        held(tmp_path, started="1")
        ready, got = threading.Barrier(8), []

        def take(ready: threading.Barrier = ready, got: list[RunLock] = got) -> None:
            own = RunLock(tmp_path, note=lambda line: None)
            ready.wait()
            with contextlib.suppress(ValueError):
                got.append(own.__enter__())

        threads = [threading.Thread(target=take) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(got) == 1
        got[0].check()
        got[0].__exit__()
