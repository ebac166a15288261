"""Run programs of other libraries, in separate virtual environments if they need other package versions.

``peers/NAME/requirements.txt`` pins the packages of a library. The first use makes a virtual environment in
``~/.cache/lyceum_warp/peers`` (or ``$LYCEUM_WARP_PEERS``).
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
from pathlib import Path
from typing import Any

import experiment

FOLDER = experiment.FOLDER / "peers"


def run(python: Path, worker: Path, **arguments: Any) -> dict[str, Any]:
    """Run a worker that reads a JSON object from stdin, and prints a JSON object as its last line."""
    # the other virtual environment must not import packages of this one
    hidden = () if python == Path(sys.executable) else ("PYTHONPATH", "PYTHONHOME")
    env = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [str(python), str(worker)]
    done = subprocess.run(command, input=json.dumps(arguments), env=env, timeout=600, capture_output=True, text=True)
    if done.returncode != 0:
        if missing := re.search(r"^ModuleNotFoundError: No module named '(\w+)", done.stderr, re.MULTILINE):
            raise experiment.Skipped(f"{worker.name} needs the package {missing[1]}, which is not installed")
        raise RuntimeError(f"{worker} failed with {arguments}:\n{done.stderr[-3000:]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


@functools.cache
def _made(name: str) -> tuple[Path, str]:
    """Make the virtual environment of a library unless it exists.

    Return the path of its Python interpreter, and an error message, or "" after success.
    """
    requirements = FOLDER / name / "requirements.txt"
    text = "\n".join([requirements.read_text(), sys.version, platform.machine()])
    root = Path(os.environ.get("LYCEUM_WARP_PEERS") or Path.home() / ".cache" / "lyceum_warp" / "peers")
    folder = root / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    python, complete = folder / "bin" / "python", folder / "complete"
    root.mkdir(parents=True, exist_ok=True)
    with folder.with_name(folder.name + ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if complete.exists():
            return python, ""
        print(f"making a virtual environment for {name}: {folder}", flush=True)
        shutil.rmtree(folder, ignore_errors=True)
        # installing pip into the new environment would take seconds
        pip = [sys.executable, "-m", "pip", "--python", str(python), "--disable-pip-version-check", "--retries", "1"]
        for command in (
            [sys.executable, "-m", "venv", "--without-pip", str(folder)],
            [*pip, "install", "--timeout", "15", "--quiet", "-r", str(requirements)],
        ):
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode != 0:
                shutil.rmtree(folder, ignore_errors=True)
                said = [line for line in (done.stderr or done.stdout).splitlines() if line.strip()] or ["no message"]
                return python, f"{name} cannot be installed: {said[-1].strip()}"
        complete.touch()  # written last, because the program may be killed during the installation
    return python, ""


def python_of(name: str) -> Path:
    python, reason = _made(name)
    if reason:
        raise experiment.Skipped(reason)
    return python
