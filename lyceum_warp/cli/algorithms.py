"""Make flags of the hyperparameters of all algorithms of lyceum-warp train."""

import dataclasses
from typing import Any

from lyceum_warp.cli.arguments import given, optional_flags
from lyceum_warp.runs.configuration import ALGORITHMS, algorithm_of


def _default(name: str) -> str:
    """Which algorithms have a hyperparameter, and its default in each."""
    texts = []
    for algorithm, (_, config) in ALGORITHMS.items():
        if name in config.__dataclass_fields__:
            value = getattr(config, name)
            words = " ".join(map(str, value)) if isinstance(value, tuple) else "" if value is None else str(value)
            texts.append(f"{algorithm} {words}".strip())
    return f"({', '.join(texts)})"


@optional_flags(*(config for _, config in ALGORITHMS.values()), default=_default)
class Hyperparameters:
    """Hyperparameters, each with the algorithms that have it and their defaults."""

    def on_top_of(self, config: Any, algorithm: str) -> Any:
        """The hyperparameters of an algorithm, with those that are given.

        Args:
            config: Those that are not given; None for the defaults.
            algorithm: The algorithm.

        Raises:
            ValueError: A value is not valid, or belongs to another algorithm.
        """
        values, (_, kind) = given(self), algorithm_of(algorithm)
        for name in values.keys() - kind.__dataclass_fields__.keys():
            fitting = " or ".join(
                other for other, (_, config) in ALGORITHMS.items() if name in config.__dataclass_fields__
            )
            raise ValueError(
                f"--{name.replace('_', '-')} is a setting of {fitting}, not of {algorithm}: leave it out, or give "
                f"--algorithm {fitting}"
            )
        return kind(**values) if config is None else dataclasses.replace(config, **values)
