"""Describe a measurement: packages, machine and commit, and a GPU's driver, power limit and clocks."""

import dataclasses
import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lyceum_warp.support.versions import versions

HARDWARE = ("cpu", "cores", "gpu", "driver", "power_limit")

_QUERY = {
    "driver": "driver_version",
    "power_limit": "power.limit",
    "clock_sm": "clocks.sm",
    "clock_sm_max": "clocks.max.sm",
    "clock_memory": "clocks.mem",
    "throttled": "clocks_event_reasons.active",
}


def context(device: str = "cpu") -> dict[str, Any]:
    found = versions(device)
    program = shutil.which("nvidia-smi") if device.startswith("cuda") else None
    if program is not None:
        index = device.partition(":")[2] or "0"
        command = [program, f"--id={index}", f"--query-gpu={','.join(_QUERY.values())}", "--format=csv,noheader"]
        done = subprocess.run(command, capture_output=True, text=True)
        values = [value.strip() for value in done.stdout.strip().split(",")]
        if done.returncode == 0 and len(values) == len(_QUERY):
            found |= dict(zip(_QUERY, values, strict=True))
    return found


def write(path: Path, rows: Sequence[Any], device: str = "cpu", **more: Any) -> None:
    """Write dataclasses and their context as JSON, right after the measurement, because this reads the GPU's clocks."""
    content = {"versions": context(device), "rows": [dataclasses.asdict(row) for row in rows], **more}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2) + "\n")
