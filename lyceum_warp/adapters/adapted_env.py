"""Make the environment, the seeds and the renderer that an adapter uses."""

from collections.abc import Callable, Mapping
from typing import Any

import torch

from lyceum_warp.env import Env, make
from lyceum_warp.support.validate import whole_number
from lyceum_warp.task import Task
from lyceum_warp.viz.cameras import CameraChoice
from lyceum_warp.viz.pictures import WorldPictures

_SEEDS = 2**31

_OTHER_WORDS = {"nworld": "num_envs", "autoreset": "autoreset_mode (in adapters that have it)"}
"""Options of ``lw.make`` that are arguments of adapters, under another name."""


def environment_of(
    task: str | type[Task] | Env, num_envs: int | None, words: Mapping[str, Any], *, autoreset: bool
) -> Env:
    """Make an adapter's environment from a task, or check the given environment."""
    if not isinstance(task, Env):
        for word in _OTHER_WORDS.keys() & words.keys():
            raise ValueError(f"{word}= is not an argument of an adapter: use {_OTHER_WORDS[word]}")
        return make(task, nworld=1 if num_envs is None else whole_number("num_envs", num_envs, low=1),
                    autoreset=autoreset, **words)  # fmt: skip
    if words:
        raise ValueError(f"the environment already has its options: pass {', '.join(words)} to lw.make")
    if num_envs not in (None, task.nworld):
        raise ValueError(f"the environment has {task.nworld} worlds, not num_envs={num_envs}: omit num_envs")
    if task.autoreset is not autoreset:
        raise ValueError(f"the environment has autoreset={task.autoreset}: make it with autoreset={autoreset}")
    return task


def pictures_of(
    env: Env, render_mode: str | None, camera: CameraChoice, size: tuple[int, int]
) -> tuple[WorldPictures, dict[str, Any]]:
    """Make an environment's renderer, and the ``metadata`` for Gymnasium and Stable-Baselines3."""
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"there is no render_mode {render_mode!r}: use 'rgb_array', or None for no pictures")
    metadata = {"render_modes": ["rgb_array"], "render_fps": max(1, round(1 / env.timestep))}
    return WorldPictures(env, camera=camera, size=size), metadata


class ResetSeeds:
    """Chooses the seed of each reset. The first one is random unless the user gave a seed."""

    def __init__(self, *, seeded: bool) -> None:
        self._seeded = seeded

    def __call__(self, given: Any, drawn: Callable[[], Any]) -> int | None:
        """Return the seed of a reset, or None to continue the random streams."""
        if given is None and self._seeded:
            return None
        self._seeded = True
        return whole_number("seed", drawn() if given is None else given, low=0, high=2**128) % _SEEDS


def per_world(value: Any, nworld: int) -> list[Any]:
    """Split a tensor with one row per world, or repeat any other value."""
    if isinstance(value, torch.Tensor) and value.ndim and len(value) == nworld:
        return list(value)
    return [value] * nworld
