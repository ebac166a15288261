"""Record the runs that this user made or trusts. Files of other runs are neither executed nor read."""

import datetime
import hashlib
import json
import logging
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)


def remember(folder: Path, config: Mapping[str, Any]) -> None:
    """Record a run as trusted in this user's state directory."""
    record = _record(folder, config)
    try:
        record.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        record.write_text(f"{folder.resolve()}\n{datetime.datetime.now():%Y-%m-%d %H:%M:%S}\n")
    except OSError as error:
        log.warning("later commands need --trust for the run in %s, because %s cannot be written (%s)",
                    folder, record, error.strerror)  # fmt: skip


def check_trust(folder: Path, config: Mapping[str, Any], named: str | Path, *, runs: bool, trust: bool) -> None:
    """Check that this user made a run on this machine, or trusts the run. Record it as trusted if ``trust`` is set.

    ``named`` is the file in the error message. ``runs`` is True if the command would run this file, and False if the
    command would read it.
    """
    if os.path.exists(_record(folder, config)):
        return
    if not trust:
        raise ValueError(
            f"the run in {folder} was not made by you on this machine, and the command would "
            f"{'run' if runs else 'read'} {named}: look at the folder, then allow the run with --trust"
        )
    remember(folder, config)


def _record(folder: Path, config: Mapping[str, Any]) -> Path:
    """Get the file that records a run as trusted. Its name is a hash of all that the run can execute or read."""
    kept = config.get("kept", {})
    paths = [{key: value for key, value in config.get(part, {}).items() if isinstance(value, str)}
             for part in ("params", "options")]  # fmt: skip
    found = hashlib.sha256(json.dumps([config.get("task"), kept, paths], sort_keys=True).encode())
    task = folder / "task"
    # hash the run's copy, so that the run stays trusted if the user edits the original
    main = task / kept["file"] if "file" in kept else Path(str(config.get("task")).partition(":")[0])
    for name, path in [*((str(path.relative_to(task)), path) for path in sorted(task.rglob("*"))), ("", main)]:
        link, content = os.readlink(path) if path.is_symlink() else None, ""
        if path.is_file():
            with path.open("rb") as file:
                content = hashlib.file_digest(file, "sha256").hexdigest()
        found.update(json.dumps([name, link, content]).encode())
    state = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    return Path(state, "lyceum_warp", "trusted", found.hexdigest())
