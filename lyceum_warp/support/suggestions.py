"""Suggest known names for a misspelt name, or for a name from another library."""

import difflib
import functools
from collections.abc import Iterable
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type)
Value = TypeVar("Value")

_OTHER_WORDS = {
    # environments
    "num_envs": "nworld", "n_envs": "nworld", "max_episode_steps": "horizon", "xml_file": "model", "record": "graphs",
    "observation_space": "obs_space", "single_observation_space": "obs_space", "single_action_space": "action_space",
    "rewards": "reward", "dones": "done", "obs_buf": "obs",
    # learning
    "lr": "learning_rate", "gae_lambda": "lam", "clip_range": "clip", "clip_param": "clip", "ent_coef": "entropy_coef",
    "vf_coef": "value_coef", "value_loss_coef": "value_coef", "n_steps": "num_steps", "num_steps_per_env": "num_steps",
    "n_epochs": "epochs", "num_learning_epochs": "epochs", "num_mini_batches": "minibatches", "batch_size": "batch",
    "buffer_size": "replay", "learning_starts": "warmup", "max_iterations": "iterations",
    "log_dir": "out", "folder": "out",
    # planning
    "num_samples": "samples", "lambda_": "temperature",
}  # fmt: skip
"""Names in other libraries and earlier releases, each with the name in this release."""


def closest(name: str, choices: Iterable[str], most: int = 3, cutoff: float = 0.6) -> list[str]:
    """Return the known name for another library's name, or else the most similar known names.

    ``cutoff`` is the least similarity, from 0 to 1.
    """
    choices = list(choices)
    other = _OTHER_WORDS.get(name, "")
    return [other] if other in choices else difflib.get_close_matches(name, choices, most, cutoff)


def did_you_mean(name: str, choices: Iterable[str], otherwise: str = "") -> str:
    """Return "did you mean ...?" with up to three names from ``closest``; if there is none, return ``otherwise``."""
    close = closest(name, choices)
    return f"did you mean {' or '.join(close)}?" if close else otherwise


def suggest_arguments(cls: Class) -> Class:
    """Class decorator of a dataclass: the error for an unknown argument suggests a known one."""
    init, fields = cls.__init__, cls.__dataclass_fields__  # type: ignore[misc, attr-defined]

    @functools.wraps(init)
    def checked(self: Any, *args: Any, **arguments: Any) -> None:
        if unknown := [argument for argument in arguments if argument not in fields]:
            hint = did_you_mean(unknown[0], fields, f"it has {', '.join(fields)}")
            raise TypeError(f"{cls.__name__} has no field {unknown[0]!r}: {hint}")
        init(self, *args, **arguments)

    cls.__init__ = checked  # type: ignore[misc]
    return cls


class Named(dict[str, Value]):
    """A dict whose KeyError suggests a known name. ``kind`` is the noun for a name, such as "metric"."""

    def __init__(self, kind: str, values: Any = ()) -> None:
        super().__init__(values)
        self._kind = kind

    def __missing__(self, name: str) -> Value:
        hint = did_you_mean(name, self, f"there are {', '.join(self) or 'none'}")
        raise KeyError(f"there is no {self._kind} {name!r}: {hint}")
