"""Make and check the environment behind an adapter, its seeds and its pictures."""

from collections.abc import Callable, Mapping
from typing import Any

import torch

from lyceum_warp.env import Env, make
from lyceum_warp.support.validate import whole_number
from lyceum_warp.task import Task
from lyceum_warp.viz.cameras import CameraChoice
from lyceum_warp.viz.pictures import WorldPictures

_SEEDS = 2**31
"""Upper bound (exclusive) of an environment's seeds."""

_OTHER_WORDS = {"nworld": "num_envs", "autoreset": "autoreset_mode (in adapters that have it)"}
"""Options that an adapter sets itself, each with the argument that replaces it."""


def environment_of(
    task: str | type[Task] | Env, num_envs: int | None, words: Mapping[str, Any], *, autoreset: bool
) -> Env:
    """Make the environment behind an adapter, or check a given one.

    Args:
        task: A task, as in ``lw.make``, or an environment.
        num_envs: Number of worlds; by default one, or the number in the given environment.
        words: Options and parameters, for ``lw.make``.
        autoreset: Whether the environment resets worlds within a step.

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
        raise ValueError(f"the environment has {task.nworld} worlds, not num_envs={num_envs}: omit num_envs")
    if task.autoreset is not autoreset:
        raise ValueError(f"the environment has autoreset={task.autoreset}: make it with autoreset={autoreset}")
    return task


def pictures_of(
    env: Env, render_mode: str | None, camera: CameraChoice, size: tuple[int, int]
) -> tuple[WorldPictures, dict[str, Any]]:
    """The renderer of an environment's worlds, and the entries of a library's ``metadata`` that describe it.

    Raises:
        ValueError: There is no such render mode or camera, or the size is odd.
    """
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"there is no render_mode {render_mode!r}: use 'rgb_array', or None for no pictures")
    metadata = {"render_modes": ["rgb_array"], "render_fps": max(1, round(1 / env.timestep))}
    return WorldPictures(env, camera=camera, size=size), metadata


class ResetSeeds:
    """Chooses the seed of each reset. If the first reset has no seed, one is drawn at random, as libraries expect.

    Args:
        seeded: Whether the user has seeded the environment.
    """

    def __init__(self, *, seeded: bool) -> None:
        self._seeded = seeded

    def __call__(self, given: Any, drawn: Callable[[], Any]) -> int | None:
        """The seed of this reset; None continues the random streams.

        Args:
            given: The seed passed to reset, of any size, or None.
            drawn: Returns a random seed, for worlds that were never seeded.
        """
        if given is None and self._seeded:
            return None
        self._seeded = True
        return whole_number("seed", drawn() if given is None else given, low=0, high=2**128) % _SEEDS


def per_world(value: Any, nworld: int) -> list[Any]:
    """A list with one value per world: the tensor's rows if there is one per world, else the value repeated."""
    if isinstance(value, torch.Tensor) and value.ndim and len(value) == nworld:
        return list(value)
    return [value] * nworld
