"""Follow a training run: show its newest policy in worlds of the viewer's own.

The run is not touched: the viewer reads the files that training writes. So a run has the same numbers with and without
it, also where both run on different machines that share the folder.
"""

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import torch

from lyceum_warp.algos.policy import acting
from lyceum_warp.runs.checkpoints import read_checkpoint
from lyceum_warp.runs.folder import Run, load

_NICE = 10  # how much the process of `RunViewer` gives way to the training


class Follower:
    """A policy that takes the newest weights of a run: ``policy(obs)`` is the mean action.

    Args:
        run: The run.
        device: Device of the worlds in which it acts.

    Raises:
        FileNotFoundError: The run has no policy yet.
        ValueError: The policy cannot be read, or has a network of its own.
    """

    def __init__(self, run: Run, *, device: str | torch.device = "cpu") -> None:
        self.run, self.device = run, device
        self._seen = self._stamp()
        self.policy = load(run, device=device)
        self.iteration = self._read()["iteration"]

    def __call__(self, obs: torch.Tensor) -> torch.Tensor:
        """Mean actions, (..., nact)."""
        return acting(self.policy)(obs)

    def update(self) -> list[str]:
        """Take new weights if there are some; returns messages about it."""
        stamp = self._stamp()
        if stamp is None or stamp == self._seen:
            return []
        try:
            content = self._read()
            self.policy.load_state_dict(content["policy"]["state"])
        except (FileNotFoundError, ValueError, RuntimeError) as error:  # a file that is just replaced, or a new run
            self._seen = stamp
            return [f"the policy of {self.run.folder} was not read: {str(error).splitlines()[0]}"]
        self._seen, self.iteration = stamp, content["iteration"]
        return [f"policy of iteration {self.iteration}{self._return()}"]

    def _read(self) -> dict[str, Any]:
        return read_checkpoint(self.run.policy_file(), self.device, parts=("iteration", "policy"))

    def _stamp(self) -> tuple[int, int, int] | None:
        """What changes when the file is replaced."""
        try:
            found = os.stat(self.run.policy_file())
        except OSError:
            return None
        return found.st_mtime_ns, found.st_ino, found.st_size

    def _return(self) -> str:
        """The last return in the run's table, in words."""
        try:
            row = self.run.rows()[-1]
        except (FileNotFoundError, ValueError, IndexError):
            return ""
        for name in ("mean_return", "return_mean"):
            if (value := row.get(name)) is not None and value == value:
                return f", return {value:.6g}"
        return ""


def wait_for_run(folder: Path, *, seconds: float, going_on: Any = lambda: True) -> Run:
    """Wait until a run has a policy.

    Args:
        folder: The run's folder.
        seconds: How long.
        going_on: Called now and then; the wait ends where it returns False.

    Raises:
        FileNotFoundError: There is no run, or it has no policy.
    """
    end = time.monotonic() + seconds
    while True:
        try:
            run = Run.open(folder)
            if run.policy_file().is_file():
                return run
            problem = f"the run in {folder} has no policy yet: train it first"
        except FileNotFoundError as error:
            problem = str(error)
        if time.monotonic() >= end or not going_on():
            raise FileNotFoundError(problem)
        time.sleep(0.2)


class RunViewer:
    """Shows a run while it trains, in a process of its own: ``lw.train(npg, folder, callback=lw.RunViewer(folder))``.

    The process waits for the folder, follows its newest policy in worlds of its own on the CPU, and gives way to the
    training where cores are scarce. It ends with ``close``, at the end of a ``with`` block, and with this program. A
    window that is closed does not end the training.

    Args:
        folder: The run's folder, which need not exist yet.
        options: Further flags of ``lyceum-warp view`` by their names, as ``gfx="web"``, ``port=8080``, ``nworld=64``.
    """

    def __init__(self, folder: str | Path, **options: Any) -> None:
        self.folder = Path(folder)
        job = json.dumps({"folder": str(self.folder.absolute()), "options": options})
        # not by multiprocessing, which would import the caller's program again
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", "from lyceum_warp.cli.view import attached; attached()"],
            stdin=subprocess.PIPE, text=True, process_group=0,
        )  # fmt: skip
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # a process that ended at once has printed why
            self._process.stdin.write(job + "\n")
            self._process.stdin.flush()

    def __call__(self, iteration: Any) -> None:
        """Nothing: the viewer reads the run's files. It makes the viewer a callback of ``lw.train``."""

    @property
    def is_open(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def close(self) -> None:
        """End the process. A second call does nothing."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()  # the process ends
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> "RunViewer":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class Parent:
    """The program that started this process, and its end of a pipe.

    It reads the job, and notices when that program closes the pipe or ends.
    """

    def __init__(self) -> None:
        with contextlib.suppress(OSError, AttributeError):  # not on Windows
            os.nice(_NICE)
        self.job: dict[str, Any] = json.loads(sys.stdin.readline())
        self.ended = threading.Event()
        threading.Thread(target=self._listen, daemon=True, name="lyceum_warp parent").start()

    def _listen(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            while sys.stdin.read(1):
                pass
        self.ended.set()
