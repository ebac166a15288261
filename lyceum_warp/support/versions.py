"""Collect package versions and data about the machine."""

import contextlib
import functools
import importlib.metadata
import platform
import shutil
import subprocess
from pathlib import Path
from typing import Any

import torch

from lyceum_warp.support.machine import cpu_cores

_PACKAGES = ("lyceum-warp", "mujoco", "mujoco-warp", "warp-lang", "torch", "numpy", "gymnasium")


def versions(device: str = "cpu") -> dict[str, Any]:
    """Return the versions of packages and Python, a description of the machine, and the commit of a git checkout."""
    entries: dict[str, Any] = {}
    for package in _PACKAGES:
        try:
            entries[package.replace("-", "_")] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            entries[package.replace("-", "_")] = None
    entries["torch"] = torch.__version__  # the version includes the build, such as +cpu
    entries["python"] = platform.python_version()
    entries["platform"] = platform.platform()
    entries["cpu"] = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        entries["cpu"] = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    entries["cores"] = cpu_cores()
    if device.startswith("cuda") and torch.cuda.is_available():
        entries["gpu"] = torch.cuda.get_device_name(device)
        entries["cuda"] = torch.version.cuda
    if commit := _commit():
        entries["commit"] = commit
    return entries


@functools.cache
def _commit() -> str | None:
    root = Path(__file__).resolve().parent.parent.parent
    git = shutil.which("git")
    # an installed package may lie inside another project's checkout
    if git is None or not (root / ".git").exists():
        return None
    command = [git, "describe", "--always", "--dirty", "--abbrev=40"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True)
    return done.stdout.strip() or None
