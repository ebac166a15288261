"""What the adapters have in common: the environment behind them, and its buffers as NumPy arrays."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from lyceum_warp.arrays import torch_view
from lyceum_warp.env import Env, make
from lyceum_warp.task import Task
from lyceum_warp.validate import described, whole_number

_SEEDS = 2**31
"""Seeds of an environment lie below this number."""

_OTHER_WORDS = {"nworld": "num_envs", "autoreset": "the adapter's way to reset"}


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


class SeedOnce:
    """The seed of a reset, where a library expects that only the first reset without one draws it.

    Args:
        seeded: Whether the environment's streams were seeded by the user.
    """

    def __init__(self, *, seeded: bool) -> None:
        self._seeded = seeded

    def __call__(self, given: Any, drawn: Any) -> int | None:
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


class HostArrays:
    """The buffers of an environment as NumPy arrays: actions go in, results come out.

    Args:
        env: The environment.
        copy: Whether results are copies. Without, those of an environment on the CPU are its live buffers, which
            change with the next step.
        one_world: Whether actions are those of the only world, without its axis.
    """

    def __init__(self, env: Env, *, copy: bool = True, one_world: bool = False) -> None:
        self._env, self._copy = env, copy
        # an environment on the CPU shares its buffer; for another one the copy to the device starts from pinned memory
        pinned = torch.empty(env.action.shape, pin_memory=True) if env.action.is_cuda else None
        self._pinned = pinned
        actions = (env.action if pinned is None else pinned).numpy()
        self._action = actions[0] if one_world else actions

    def set_action(self, action: Any) -> None:
        """Copy actions into the environment, (nworld, nact) or (nact,), float32 or float64.

        Raises:
            ValueError: They are not a NumPy array, or one of another shape or type.
        """
        if not isinstance(action, np.ndarray) or action.shape != self._action.shape or action.dtype.kind != "f":
            raise ValueError(f"actions must be a float32 array of shape {self._action.shape}, not {_described(action)}")
        np.copyto(self._action, action, casting="same_kind")
        if self._pinned is not None:
            self._env.action.copy_(self._pinned, non_blocking=True)

    def of(self, *tensors: torch.Tensor) -> list[np.ndarray]:
        """The values of some tensors of the environment's device, after at most one wait for it."""
        if self._pinned is None:
            return [tensor.numpy().copy() if self._copy else tensor.numpy() for tensor in tensors]
        copies = [tensor.to("cpu", non_blocking=True) for tensor in tensors]
        torch.cuda.current_stream(self._env.action.device).synchronize()
        return [copy.numpy() for copy in copies]


def _described(value: Any) -> str:
    return f"a {value.dtype} array of shape {value.shape}" if isinstance(value, np.ndarray) else described(value)


class Infos:
    """What an environment says about a step beside its results, by name.

    ``eval`` is the evaluation metric of the state that the step led to, ``done_reason`` has the bits of ``lw.Done``,
    ``success`` is there where the task has a goal; ``metrics`` and ``episode_metrics`` (their sums over the episode of
    the step) where it has metrics.

    Args:
        env: The environment.
    """

    def __init__(self, env: Env) -> None:
        self._plain = {"eval": env.eval, "done_reason": env.done_reason}
        if env.task.functions["success"] is not None:
            self._plain["success"] = env.success
        self._metrics = {}
        if env.metrics:
            self._metrics = {"metrics": torch_view(env.worlds.metrics), "episode_metrics": env.episode_metric_sums}
        self._names = tuple(env.metrics)

    @property
    def tensors(self) -> list[torch.Tensor]:
        """The buffers that hold it all."""
        return [*self._plain.values(), *self._metrics.values()]

    def named(self, values: list[Any]) -> dict[str, Any]:
        """Values of the buffers in their order, tensors or arrays, by name."""
        infos = dict(zip(self._plain, values, strict=False))
        for name, table in zip(self._metrics, values[len(self._plain) :], strict=True):
            infos[name] = dict(zip(self._names, table.T, strict=True))
        return infos


def per_world(value: Any, nworld: int) -> list[Any]:
    """A value once for each world: rows of a tensor that has one for each world, otherwise the same value."""
    if isinstance(value, torch.Tensor) and value.ndim and len(value) == nworld:
        return list(value)
    return [value] * nworld


class Observations:
    """The observations that an adapter gives: those of the group ``policy``, or of every group by its name.

    Args:
        env: The environment.
        dict_obs: Whether to give every group; None where there are several.
    """

    def __init__(self, env: Env, *, dict_obs: bool | None) -> None:
        self._env = env
        self.dict_obs = len(env.obs_groups) > 1 if dict_obs is None else dict_obs
        self._groups = list(env.obs_groups) if self.dict_obs else ["policy"]

    @property
    def current(self) -> list[torch.Tensor]:
        """The observations of each group, (nworld, size); without automatic resets the last ones of ended episodes."""
        env = self._env
        if env.autoreset:
            return [env.obs_groups[group] for group in self._groups]
        # a world with a fault has restarted even then, and its observation is that of its next episode
        done = env.done[:, None]
        return [torch.where(done, env.final_obs_groups[group], env.obs_groups[group]) for group in self._groups]

    @property
    def final(self) -> list[torch.Tensor]:
        """The same of the states that the last step led to, before any reset."""
        return [self._env.final_obs_groups[group] for group in self._groups]

    @property
    def count(self) -> int:
        """Number of groups."""
        return len(self._groups)

    def formed(self, values: list[Any]) -> Any:
        """Values of the groups as the library takes them: one array, or a dict of arrays."""
        return dict(zip(self._groups, values, strict=True)) if self.dict_obs else values[0]

    def rows(self, values: list[np.ndarray]) -> list[Any]:
        """Arrays of the groups, (worlds, size of the group), as one observation for each world."""
        return [self.formed(list(row)) for row in zip(*values, strict=True)]
