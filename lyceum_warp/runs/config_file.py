"""Read a run's config.json, and check the types of all entries that the package reads."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lyceum_warp.runs.checkpoints import check_format
from lyceum_warp.support.validate import whole_number

_COUNT = 0
"""Stands for the type of entries that are non-negative whole numbers."""

_ENTRIES: dict[str, Any] = {
    "task": str | None, "params": dict, "options": dict, "physics": dict, "engine": str, "device": str,
    "algorithm": str, "nworld": _COUNT, "threads": _COUNT, "seed": _COUNT, "iterations": _COUNT, "keep_every": _COUNT,
    "save_every": _COUNT, "video_every": _COUNT, "tensorboard": bool, "target_return": float | int | None,
    "reached": {"iteration": _COUNT, "return": float | int},
    "kept": {"name": str, "file": str, "model": str, "model_given": bool, "source_hash": str, "model_hash": str,
             "modules": dict, "program": bool},
    "versions": dict, "resumed": list,
}  # fmt: skip
"""Map each entry to a type, ``_COUNT``, or a dict of entries. All entries are optional."""


def read_config(path: Path) -> dict[str, Any]:
    """Read the configuration of a training run or a planner run.

    Args:
        path: The file.

    Raises:
        ValueError: The file is damaged or was written by a newer release, or an entry has the wrong type.
    """
    try:
        config = json.loads(path.read_text())
        number = config["format"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is not the configuration of a run of lyceum_warp ({error!r})") from error
    check_format(path, number)
    kinds = _ENTRIES | {str(config.get("algorithm")): dict, f"{config.get('algorithm')}_seed": _COUNT}
    try:
        _check(config, kinds)
        _check(config.get("kept", {}).get("modules", {}), dict.fromkeys(config.get("kept", {}).get("modules", {}), str))
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    return config


def _check(entries: Any, kinds: Mapping[str, Any]) -> None:
    if not isinstance(entries, dict):
        raise ValueError(f"{entries!r} is not a dict of {', '.join(kinds)}")
    for name in kinds.keys() & entries.keys():
        kind, value = kinds[name], entries[name]
        if kind is _COUNT:
            whole_number(name, value, low=0)
        elif isinstance(kind, dict):
            _check(value, kind)
        elif not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            wanted = getattr(kind, "__name__", kind)
            raise ValueError(f"{name} must be of type {wanted}, not {value!r}")
