"""Peers that cannot share our environment, because they need other versions of what we use.

``peers/NAME/requirements.txt`` pins what a peer needs, ``peers/NAME/worker.py`` measures it. The peer's virtual
environment is made when it is needed first, under ``~/.cache/lyceum_warp/peers`` (or ``$LYCEUM_WARP_PEERS``), one for
each set of requirements and each Python:

    python bench/peers.py dm_control judo      # makes them ahead of time
"""

import fcntl
import functools
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import experiment
import tyro

FOLDER = experiment.FOLDER / "peers"


@dataclass(frozen=True)
class Peer:
    """A peer with its environment."""

    name: str
    python: Path
    """Interpreter of the virtual environment."""
    worker: Path
    ours: bool = False
    """Whether it shares our environment."""

    def run(self, *, timeout: float = 600.0, **arguments: Any) -> dict[str, Any]:
        """Run the worker: it reads one JSON object, and the last line that it prints is one.

        Args:
            timeout: Seconds after which it is killed.
            **arguments: Entries of the object.

        Raises:
            experiment.Skipped: The worker misses a package.
            RuntimeError: The worker failed.
        """
        # our own packages must not be found in an environment of the peer's own
        hidden = () if self.ours else ("PYTHONPATH", "PYTHONHOME")
        env = {name: value for name, value in os.environ.items() if name not in hidden}
        command = [str(self.python), str(self.worker)]
        done = subprocess.run(
            command, input=json.dumps(arguments), env=env, timeout=timeout, capture_output=True, text=True
        )
        if done.returncode != 0:
            if missing := re.search(r"^ModuleNotFoundError: No module named '(\w+)", done.stderr, re.MULTILINE):
                raise experiment.Skipped(f"{self.name} needs the package {missing[1]}, which is not installed")
            raise RuntimeError(f"{self.name} failed with {arguments}:\n{done.stderr[-3000:]}")
        return json.loads(done.stdout.strip().splitlines()[-1])


@functools.cache
def peer(name: str, worker: str | None = None) -> Peer:
    """A peer; its virtual environment is made if there is none yet.

    Args:
        name: Name of its folder.
        worker: Its program in the folder of all peers; by default ``NAME/worker.py``.

    Raises:
        experiment.Skipped: The environment cannot be made, for example without a network.
    """
    requirements = FOLDER / name / "requirements.txt"
    reason = _failure(name, requirements)
    if reason:
        raise experiment.Skipped(reason)
    return Peer(name, _environment(name, requirements) / "bin" / "python", FOLDER / (worker or f"{name}/worker.py"))


def peer_here(name: str, worker: str) -> Peer:
    """A peer that shares our environment, run in a process of its own."""
    return Peer(name, Path(sys.executable), FOLDER / worker, ours=True)


def _environment(name: str, requirements: Path) -> Path:
    """Folder of a peer's virtual environment."""
    text = "\n".join([requirements.read_text(), sys.version, platform.machine()])
    root = Path(os.environ.get("LYCEUM_WARP_PEERS") or Path.home() / ".cache" / "lyceum_warp" / "peers")
    return root / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


@functools.cache
def _failure(name: str, requirements: Path) -> str:
    """Make a peer's environment; returns why that failed, or an empty text."""
    folder = _environment(name, requirements)
    complete = folder / "complete"  # written last, as a program may be killed while pip is at work
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_name(folder.name + ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if complete.exists():
            return ""
        print(f"making a virtual environment for {name}: {folder}", flush=True)
        shutil.rmtree(folder, ignore_errors=True)
        # our own pip installs into it: to copy pip there first takes seconds
        python = ["--python", str(folder / "bin" / "python")]
        pip = [sys.executable, "-m", "pip", *python, "--disable-pip-version-check", "--retries", "1", "--timeout", "15"]
        for command in (
            [sys.executable, "-m", "venv", "--without-pip", str(folder)],
            [*pip, "install", "--quiet", "-r", str(requirements)],
        ):
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode != 0:
                shutil.rmtree(folder, ignore_errors=True)
                said = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()] or ["no message"]
                return f"{name} cannot be installed: {said[-1].strip()}"
        complete.touch()
    return ""


def main(names: Sequence[str]) -> int:
    known = sorted(path.parent.name for path in FOLDER.glob("*/requirements.txt"))
    failed = False
    for name in experiment.choose(names, known, what="peer"):
        try:
            print(f"{name}: {peer(name).python}")
        except experiment.Skipped as reason:
            failed = True
            print(reason, file=sys.stderr)
    return 1 if failed else 0


@dataclass(frozen=True)
class Options:
    """Make the virtual environments of peers ahead of time."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Peers; by default all."""


if __name__ == "__main__":
    options = tyro.cli(Options, prog="lyceum-warp bench peers")
    sys.exit(experiment.guarded(lambda: main(options.names), "peers"))
