"""What the adapters have in common: the environment behind them, its seeds, and its values for each world."""

from collections.abc import Callable, Mapping
from typing import Any

import torch

from lyceum_warp.env import Env, make
from lyceum_warp.support.validate import whole_number
from lyceum_warp.task import Task

_SEEDS = 2**31
"""Seeds of an environment lie below this number."""

_OTHER_WORDS = {"nworld": "num_envs", "autoreset": "autoreset_mode, where there is one,"}
"""Options of an environment that an adapter sets, and what decides instead."""


def environment_of(
    task: str | type[Task] | Env, num_envs: int | None, words: Mapping[str, Any], *, autoreset: bool
) -> Env:
    """The environment that an adapter's arguments stand for.

    Args:
        task: A task as ``lw.make`` takes it, or an environment.
        num_envs: Number of worlds; None for one, or for those of the environment.
        words: Options and parameters, for ``lw.make``.
        autoreset: Whether the environment restarts worlds within a step.

    Raises:
        ValueError: An argument does not fit; the message names it.
    """
    if not isinstance(task, Env):
        for word in _OTHER_WORDS.keys() & words.keys():
            raise ValueError(f"{word}= does not belong to an adapter: {_OTHER_WORDS[word]} decides")
        return make(task, nworld=1 if num_envs is None else whole_number("num_envs", num_envs, low=1),
                    autoreset=autoreset, **words)  # fmt: skip
    if words:
        raise ValueError(f"an environment has its options already: give {', '.join(words)} to lw.make")
    if num_envs not in (None, task.nworld):
        raise ValueError(f"the environment has {task.nworld} worlds, not num_envs={num_envs}: leave num_envs out")
    if task.autoreset is not autoreset:
        raise ValueError(f"the environment has autoreset={task.autoreset}: make it with autoreset={autoreset}")
    return task


def small_seed(seed: Any) -> int:
    """A seed of any size as one of an environment, which is below 2**31; smaller ones stay the same.

    Raises:
        ValueError: It is not a whole number of at least 0.
    """
    return whole_number("seed", seed, low=0, high=2**128) % _SEEDS


class ResetSeeds:
    """The seeds of resets, where a library expects that the first reset without one draws it.

    Args:
        seeded: Whether the environment's streams were seeded by the user.
    """

    def __init__(self, *, seeded: bool) -> None:
        self._seeded = seeded

    def __call__(self, given: Any, drawn: Callable[[], Any]) -> int | None:
        """The seed of this reset; None where the random streams go on.

        Args:
            given: The seed that the reset was given, or None.
            drawn: Called for a random seed, where the worlds never had one.
        """
        if given is None and self._seeded:
            return None
        seed = small_seed(drawn() if given is None else given)
        self._seeded = True
        return seed


def per_world(value: Any, nworld: int) -> list[Any]:
    """A value once for each world: rows of a tensor that has one for each world, otherwise the same value."""
    if isinstance(value, torch.Tensor) and value.ndim and len(value) == nworld:
        return list(value)
    return [value] * nworld
