"""Follow a training run: show its newest policy in separate worlds.

The viewer only reads the run's files. It may run on another machine that shares the folder.
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
from lyceum_warp.runs.checkpoints import policy_of, read_checkpoint
from lyceum_warp.runs.folder import Run, load


class Follower:
    """Loads the newest policy of a run. ``policy(obs)`` returns mean actions.

    Raises:
        FileNotFoundError: The run has no policy yet.
        ValueError: The policy cannot be read, or its network is a class that the user defined.
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
        """Load the weights if the file is new, and return messages for the user."""
        stamp = self._stamp()
        if stamp is None or stamp == self._seen:
            return []
        try:
            content = self._read()
            policy_of(content, self.run.policy, self.policy)
        except (FileNotFoundError, ValueError) as error:  # the training may be writing the file
            self._seen = stamp
            return [f"the policy of {self.run.folder} was not read: {str(error).splitlines()[0]}"]
        self._seen, self.iteration = stamp, content["iteration"]
        return [f"policy of iteration {self.iteration}"]

    def _read(self) -> dict[str, Any]:
        return read_checkpoint(self.run.policy_file(), self.device, parts=("iteration", "policy"))

    def _stamp(self) -> tuple[int, int, int] | None:
        try:
            found = os.stat(self.run.policy_file())
        except OSError:
            return None
        return found.st_mtime_ns, found.st_ino, found.st_size


def wait_for_run(folder: Path, *, seconds: float) -> Run:
    """Wait until a run has a policy."""
    end = time.monotonic() + seconds
    while True:
        try:
            run = Run.open(folder)
            if run.policy_file().is_file():
                return run
            problem = f"the run in {folder} has no policy yet: train it first"
        except FileNotFoundError as error:
            problem = str(error)
        if time.monotonic() >= end:
            raise FileNotFoundError(problem)
        time.sleep(0.2)


class RunViewer:
    """Shows a run while it trains, in another process: ``with lw.RunViewer(folder): lw.train(npg, folder)``.

    The viewer runs on the CPU at a lower priority than the training. It waits for the folder, and then shows the run's
    newest policy in separate worlds. It ends when ``close`` is called, when the ``with`` block ends, or when this
    program ends. Closing the viewer's window does not end the training.

    Args:
        folder: The run's folder, which need not exist yet.
        options: Flags of ``lyceum-warp view`` by name, such as ``port=8080`` or ``nworld=64``.
    """

    def __init__(self, folder: str | Path, **options: Any) -> None:
        self.folder = Path(folder)
        job = json.dumps({"folder": str(self.folder.absolute()), "options": options})
        # not multiprocessing, which would import the caller's program again
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", "from lyceum_warp.cli.view import attached; attached()"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, process_group=0,
        )  # fmt: skip
        threading.Thread(target=self._print, daemon=True).start()
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # a process that has ended has printed the reason
            self._process.stdin.write(job + "\n")
            self._process.stdin.flush()

    def _print(self) -> None:
        """Print the viewer's output here, because a live progress display must stay below it."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            print(line, end="", flush=True)

    @property
    def is_open(self) -> bool:
        """Whether the viewer's process runs."""
        return self._process.poll() is None

    def close(self) -> None:
        """End the viewer's process."""
        self._process.terminate()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()

    def __enter__(self) -> "RunViewer":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
