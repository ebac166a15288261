"""Record which runs' task code this user has run. The code of other runs is not executed unless the user names it."""

import hashlib
import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)


def remember(folder: Path, config: Mapping[str, Any]) -> None:
    """Record in this user's state directory that the user has run a run's code."""
    record = _record(folder, config)
    try:
        record.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        record.write_text(f"{folder.resolve()}\n")
    except OSError as error:
        log.warning("later commands ask for the task of the run in %s, because %s cannot be written (%s)",
                    folder, record, error.strerror)  # fmt: skip


def is_trusted(folder: Path, config: Mapping[str, Any]) -> bool:
    """Return whether this user has run a run's code on this machine."""
    return _record(folder, config).exists()


def _record(folder: Path, config: Mapping[str, Any]) -> Path:
    """Get the file that records a run. Its name is a hash of the code that the run can execute.

    This code is the task's file in config.json, the network's class, and all files of the run's copy, which may import
    each other.
    """
    task, files = folder / "task", []
    for path in sorted(task.rglob("*")):
        content = path.read_bytes() if path.is_file() else b""
        files.append([str(path.relative_to(task)), path.is_symlink(), hashlib.sha256(content).hexdigest()])
    code = [config.get("task"), config.get("kept", {}).get("file"), files]
    code += [config["network"]] if "network" in config else []
    state = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    return Path(state, "lyceum_warp", "trusted", hashlib.sha256(json.dumps(code).encode()).hexdigest())
