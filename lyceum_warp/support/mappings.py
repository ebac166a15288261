"""Flatten nested settings, and compare settings."""

import json
from collections.abc import Mapping, Sequence
from typing import Any


def flat_settings(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings to names such as "ppo.gamma"."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= flat_settings(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


def differing(mappings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names whose values differ between mappings. A name that one of them lacks differs, too."""
    names = dict.fromkeys(name for mapping in mappings for name in mapping)
    # compare texts, because NaN != NaN
    return [name for name in names if len({json.dumps(m.get(name), default=str) for m in mappings}) > 1]
