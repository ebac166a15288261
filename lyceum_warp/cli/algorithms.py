"""Generate flags for the hyperparameters of all algorithms of lyceum-warp train."""

import dataclasses
from typing import Any

from lyceum_warp.cli.arguments import OptionFlags, given
from lyceum_warp.runs.configuration import ALGORITHMS

_DEFAULTS: dict[str, list[str]] = {}
for _algorithm, (_, _config) in ALGORITHMS.items():
    for _name in _config.__dataclass_fields__:
        _value = getattr(_config, _name)
        _words = " ".join(map(str, _value)) if isinstance(_value, tuple) else "" if _value is None else str(_value)
        _DEFAULTS.setdefault(_name, []).append(f"{_algorithm} {_words}".strip())


class Hyperparameters(
    OptionFlags,
    options=[config for _, config in ALGORITHMS.values()],
    default={name: f"({', '.join(words)})" for name, words in _DEFAULTS.items()},
):
    """Hyperparameters. For each flag, the help lists the algorithms that have it, with their defaults."""

    def on_top_of(self, config: Any, algorithm: str) -> Any:
        """Override a configuration's hyperparameters with the given flags."""
        if algorithm not in ALGORITHMS:
            raise ValueError(f"there is no algorithm {algorithm!r}: use {' or '.join(ALGORITHMS)}")
        values, (_, kind) = given(self), ALGORITHMS[algorithm]
        for name in values.keys() - kind.__dataclass_fields__.keys():
            fitting = " or ".join(
                other for other, (_, config) in ALGORITHMS.items() if name in config.__dataclass_fields__
            )
            raise ValueError(
                f"--{name.replace('_', '-')} is a setting of {fitting}, not of {algorithm}: omit it, or give "
                f"--algorithm {fitting}"
            )
        return kind(**values) if config is None else dataclasses.replace(config, **values)
