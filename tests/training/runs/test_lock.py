import contextlib
import json
import os
import platform
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from training_runs import QUIET, algorithm, metrics, refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.training.runs.lock import run_lock

OTHER = """
import sys
from pathlib import Path
from lyceum_warp.training.runs.lock import run_lock
with run_lock(Path(sys.argv[1])):
    print("locked", flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[str]:
    """Lock a folder in another process. Yield the words that describe that process in error messages."""
    command = [sys.executable, "-c", OTHER, str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "locked\n"
        yield f"process {other.pid} on {platform.node()}"
        other.kill()


def test_second_writer_raises_an_error_until_the_first_writer_ends(tmp_path: Path) -> None:
    with pytest.raises(KeyError), run_lock(tmp_path):
        line = rf"the run in {tmp_path} is being written by process {os.getpid()} on {platform.node()}: end that"
        with pytest.raises(ValueError, match=line), run_lock(tmp_path):
            pass
        raise KeyError
    assert not list(tmp_path.iterdir())
    with run_lock(tmp_path):
        pass


def test_run_of_another_process_is_resumed_only_with_take_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    lw.train(algorithm(lw.make("point_mass", nworld=2)), run, 2)
    with locked(run) as process:
        before = {path: path.read_bytes() for path in run.iterdir()}
        capsys.readouterr()
        assert cli.main(["train", "--resume", str(run), "--iterations", "4", *QUIET]) == 2
        refused(capsys, f"is being written by {process}", "--take-over")
        npg = algorithm(lw.make("point_mass", nworld=2))
        with pytest.raises(ValueError, match=f"is being written by {process}"):
            lw.train(npg, lw.Run.open(run), 4)
        assert before == {path: path.read_bytes() for path in run.iterdir()}
        assert cli.main(["train", "--resume", str(run), "--iterations", "4", "--take-over", *QUIET]) == 0
    assert len(metrics(run)) == 4 and not (run / "lock").exists()


def test_lock_of_a_killed_process_is_free(tmp_path: Path) -> None:
    with locked(tmp_path):
        pass
    assert (tmp_path / "lock").exists()
    with run_lock(tmp_path):
        assert json.loads((tmp_path / "lock").read_text())["pid"] == os.getpid()


@pytest.mark.parametrize(
    "content, who", [('{"host": "far", "pid": 3}', "process 3 on far"), ("half", "another process")]
)
def test_lock_of_another_host_is_taken_over_only_on_request(content: str, who: str, tmp_path: Path) -> None:
    (tmp_path / "lock").write_text(content)
    with pytest.raises(ValueError, match=f"is being written by {who}"), run_lock(tmp_path):
        pass
    with run_lock(tmp_path, take_over=True):
        pass


def test_writer_stops_writing_after_its_lock_was_taken_over(tmp_path: Path) -> None:
    """The old writer must not remove the new writer's lock."""
    folder, found = tmp_path / "run", {}

    def callback(iteration: lw.Iteration) -> None:
        if iteration.iteration == 2:
            taker.enter_context(run_lock(folder, take_over=True))
            found.update({path: path.read_bytes() for path in folder.rglob("*.*")})

    with contextlib.ExitStack() as taker:
        with pytest.raises(ValueError, match=f"the run in {folder} was taken over by process {os.getpid()} on "):
            lw.train(algorithm(lw.make("point_mass", nworld=2)), folder, 6, save_every=1, callbacks=[callback])
        assert found == {path: path.read_bytes() for path in folder.rglob("*.*")}
        assert (folder / "lock").exists()
    assert not (folder / "lock").exists()


def test_exactly_one_of_eight_concurrent_writers_gets_the_lock(tmp_path: Path) -> None:
    for content in 10 * ["", f'{{"host": "{platform.node()}", "pid": 1}}']:
        (tmp_path / "lock").write_text(content)
        ready, got = threading.Barrier(8), []
        with contextlib.ExitStack() as held:

            def take(held: contextlib.ExitStack = held, ready: threading.Barrier = ready, got: list[Any] = got) -> None:
                ready.wait()
                with contextlib.suppress(ValueError):
                    got.append(held.enter_context(run_lock(tmp_path)))

            threads = [threading.Thread(target=take) for _ in range(8)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            (check,) = got
            check()
