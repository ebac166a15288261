"""Store the results of settings in a JSON Lines file, from which a stopped search resumes."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lyceum_warp.env import Env
from lyceum_warp.support.files import replace_text
from lyceum_warp.support.machine import cpu_cores
from lyceum_warp.support.versions import versions
from lyceum_warp.training import json_value, task_copy

_VERSIONS = ("lyceum_warp", "mujoco", "mujoco_warp")


def identity(env: Env, **more: Any) -> dict[str, Any]:
    """Describe the conditions of a search: task, machine, worlds and versions."""
    manifest, _ = task_copy(env)
    params = {name: json_value(name, value) for name, value in env.given_params.items()}
    task = {"task": manifest, "params": params, "physics": env.options.physics.given(), "horizon": env.horizon}
    machine = versions(env.device.alias)
    return {
        "task": env.task.name, "digest": hashlib.sha256(json.dumps(task, sort_keys=True).encode()).hexdigest()[:16],
        "engine": env.engine.name, "device": machine.get("gpu") or f"{machine['cpu']}, {cpu_cores()} cores",
        "nthread": env.options.nthread, "nworld": env.nworld, **{name: machine[name] for name in _VERSIONS}, **more,
    }  # fmt: skip


class RowFile:
    """Stores one row of results per setting in a file.

    Rows with another ``identity`` stay in the file, but are ignored.
    """

    def __init__(self, path: Path, identity: Mapping[str, Any]) -> None:
        self.path, self.identity = path, json.loads(json.dumps(identity))
        self._rows: dict[str, dict[str, Any]] = {}
        self._lines = path.read_text(errors="replace").splitlines() if path.exists() else []
        for number, line in enumerate(self._lines, 1):
            try:
                row = json.loads(line)
                row_identity, key = row["identity"], _key(row["physics"])
            except (ValueError, TypeError, KeyError):
                raise ValueError(f"line {number} of {path} is not a result of tune: use another file") from None
            if row_identity == self.identity:
                self._rows[key] = row

    def get(self, physics: Mapping[str, Any]) -> dict[str, Any] | None:
        """Get the row of a setting, or None."""
        return self._rows.get(_key(physics))

    def add(self, row: Mapping[str, Any]) -> dict[str, Any]:
        """Append a row to the file, and return it as read from JSON."""
        self._lines.append(json.dumps({**row, "identity": self.identity}))
        self.path.parent.mkdir(parents=True, exist_ok=True)
        replace_text(self.path, "".join(f"{line}\n" for line in self._lines))
        stored: dict[str, Any] = json.loads(self._lines[-1])
        self._rows[_key(row["physics"])] = stored
        return stored


def _key(physics: Mapping[str, Any]) -> str:
    return json.dumps(physics, sort_keys=True)
