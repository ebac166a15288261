import contextlib
import importlib
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from training_runs import train

import lyceum_warp as lw
from lyceum_warp.runs.checkpoints import policy_content, write_content
from lyceum_warp.runs.folder import Run
from lyceum_warp.viewer.follow import Follower, wait_for_run


def test_viewer_of_a_run_loads_the_newest_policy(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    npg = lw.NPG(lw.make("point_mass", nworld=2), config=lw.NPGConfig(samples=512, hidden=(8,), value_hidden=(8,)))
    followers: list[Follower] = []
    messages: list[str] = []

    def callback(iteration: lw.Iteration) -> None:
        if not followers:
            followers.append(Follower(Run.open(folder)))
        # the run does not save every short iteration
        write_content(folder / "policy.pt", policy_content(npg.iteration, npg.policy, npg.value))
        messages.extend(followers[0].update())

    lw.train(npg, folder, iterations=3, callback=callback)
    assert followers[0].iteration == 3
    assert messages[-1] == "policy of iteration 3"
    obs = torch.randn(4, npg.policy.nobs)
    with torch.no_grad():
        assert torch.equal(followers[0](obs), npg.policy(obs))


def test_viewer_of_a_run_reports_an_unreadable_policy_as_a_message(tmp_path: Path) -> None:
    assert train(tmp_path / "run", "--iterations", "1") == 0
    follower = Follower(Run.open(tmp_path / "run"))
    (tmp_path / "run" / "policy.pt").write_bytes(b"half a file")
    (message,) = follower.update()
    assert "was not read" in message and "\n" not in message
    assert follower.update() == []


def test_a_run_that_does_not_start_is_reported(tmp_path: Path) -> None:
    for message in ("there is no run in", "has no policy"):
        with pytest.raises(FileNotFoundError, match=message):
            wait_for_run(tmp_path, seconds=0.1)
        (tmp_path / "config.json").write_text('{"format": 1}')


def trained(folder: Path, callback: Callable[[lw.Iteration], object] | None = None) -> tuple[list[Any], list[Any]]:
    env = lw.make("point_mass", nworld=2, engine="mujoco", seed=3)
    npg = lw.NPG(env, config=lw.NPGConfig(samples=512, hidden=(8,), value_hidden=(8,)), seed=3)
    run = lw.train(npg, folder, iterations=4, callback=callback)
    rows = [{k: v for k, v in row.items() if "time" not in k and k != "samples_per_second"} for row in run.rows()]
    return [list(map(str, row.items())) for row in rows], list(lw.load(run).state_dict().values())


@pytest.mark.long
def test_viewer_does_not_change_the_results_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    alone = trained(tmp_path / "alone")
    begun, printed = time.monotonic(), ""
    with lw.RunViewer(tmp_path / "shown", nworld=2) as viewer:

        def callback(iteration: lw.Iteration) -> None:
            nonlocal printed
            while not re.search(r"http://127\.0\.0\.1:\d+/", printed):  # the first iteration waits for the viewer
                assert viewer.is_open and time.monotonic() < begun + 60, printed
                time.sleep(0.1)
                # this process prints the address above a progress line that is redrawn
                printed += capsys.readouterr().out

        shown = trained(tmp_path / "shown", callback)
        assert viewer.is_open
    assert not viewer.is_open
    assert alone[0] == shown[0]
    for one, other in zip(alone[1], shown[1], strict=True):
        assert torch.equal(one, other)


PROGRAM = """
import sys, time
import lyceum_warp as lw
viewer = lw.RunViewer(sys.argv[1])
print(viewer._process.pid, flush=True)
time.sleep(60)
"""


def runs(process: int) -> bool:
    with contextlib.suppress(FileNotFoundError):
        return Path(f"/proc/{process}/cmdline").read_bytes() != b""
    return False


@pytest.mark.long
def test_viewer_of_a_waiting_run_ends_with_its_program(tmp_path: Path) -> None:
    command = [sys.executable, "-c", PROGRAM, str(tmp_path / "run")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        viewer = int(program.stdout.readline())
        program.send_signal(signal.SIGKILL)
    end = time.monotonic() + 60
    while runs(viewer) and time.monotonic() < end:
        time.sleep(0.05)
    assert not runs(viewer)


def test_viewer_ends_if_it_is_closed_right_after_its_start(tmp_path: Path) -> None:
    with lw.RunViewer(tmp_path / "run") as viewer:
        assert viewer.is_open and runs(viewer._process.pid)
    assert not viewer.is_open and not runs(viewer._process.pid)


def test_train_with_view_opens_a_viewer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    # the package also has a function with this name
    training = importlib.import_module("lyceum_warp.cli.train")
    monkeypatch.setattr(
        training, "RunViewer", lambda *given, **words: made.append((given, words)) or contextlib.nullcontext()
    )
    assert train(tmp_path / "run", "--iterations", "1", "--view", "--port", "8123") == 0
    assert made == [((tmp_path / "run",), {"port": 8123})]


@pytest.mark.long
def test_viewer_of_a_run_whose_task_is_missing_prints_one_line_and_ends(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", "--iterations", "1") == 0
    run = Run.open(tmp_path / "run")
    run.amend(task="missing_task")
    with lw.RunViewer(tmp_path / "run") as viewer:
        begun = time.monotonic()
        while viewer.is_open and time.monotonic() < begun + 60:
            time.sleep(0.1)
    lines = capfd.readouterr().err.splitlines()
    assert sum("the viewer of" in line and "missing_task" in line for line in lines) == 1
    assert not any("Traceback" in line for line in lines)
