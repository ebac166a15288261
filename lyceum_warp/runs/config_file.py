"""Read a run's config.json, and check the types of its entries."""

import json
from pathlib import Path
from typing import Any

from lyceum_warp.runs.checkpoints import FORMAT
from lyceum_warp.support.files import unknown_format
from lyceum_warp.support.validate import whole_number

_COUNT = 0
"""Stands for whole numbers from 0 in ``_ENTRIES``."""

_ENTRIES: dict[str, Any] = {
    "task": str | None, "params": dict, "options": dict, "physics": dict, "engine": str, "device": str,
    "algorithm": str, "nworld": _COUNT, "threads": _COUNT, "seed": _COUNT, "iterations": _COUNT, "keep_every": _COUNT,
    "save_every": _COUNT, "video_every": _COUNT, "tensorboard": bool, "target_return": float | int | None,
    "reached": dict, "kept": dict, "versions": dict, "resumed": list,
}  # fmt: skip
_REACHED: dict[str, Any] = {"iteration": _COUNT, "return": float | int}
_KEPT: dict[str, Any] = {
    "name": str, "file": str, "model": str, "model_given": bool, "source_hash": str, "model_hash": str, "modules": dict,
    "program": bool,
}  # fmt: skip
"""Types of the entries of config.json. All entries are optional."""


def read_config(path: Path) -> dict[str, Any]:
    """Read the configuration of a training run or a planner run."""
    try:
        config = json.loads(path.read_text())
        number = config["format"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is not the configuration of a run of lyceum_warp ({error!r})") from error
    if not isinstance(number, int) or number != FORMAT:
        raise unknown_format(path, number, FORMAT)
    algorithm = config.get("algorithm")
    own = {str(algorithm): dict, f"{algorithm}_seed": _COUNT}
    try:
        for part, kinds in (None, _ENTRIES | own), ("reached", _REACHED), ("kept", _KEPT):
            entries = config if part is None else config.get(part, {})
            for name in kinds.keys() & entries.keys():
                kind, value = kinds[name], entries[name]
                if kind is _COUNT:
                    whole_number(name, value, low=0)
                elif not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
                    raise ValueError(f"{name} must be of type {getattr(kind, '__name__', kind)}, not {value!r}")
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    return config
