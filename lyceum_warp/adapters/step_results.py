"""Convert actions, observations and infos of a step to the formats of other libraries."""

from collections.abc import Callable
from itertools import islice
from typing import Any

import numpy as np
import torch

from lyceum_warp.env import Env
from lyceum_warp.support.arrays import torch_view
from lyceum_warp.support.validate import described


class Observations:
    """Returns observations in an adapter's format: the group ``policy``, or a dict of all groups.

    Args:
        dict_obs: Whether to return a dict of all groups.
    """

    def __init__(self, env: Env, *, dict_obs: bool | None) -> None:
        self._env = env
        self.dict_obs = len(env.obs_groups) > 1 if dict_obs is None else dict_obs
        self._groups = list(env.obs_groups) if self.dict_obs else ["policy"]

    @property
    def current(self) -> list[torch.Tensor]:
        """The current observations by group, (nworld, size).

        Without automatic resets, worlds whose episode ended keep their last observation.
        """
        env = self._env
        if env.autoreset:
            return [env.obs_groups[group] for group in self._groups]
        # a fault always resets a world, whose row is then already the first of the next episode
        done = env.done[:, None]
        return [torch.where(done, env.final_obs_groups[group], env.obs_groups[group]) for group in self._groups]

    @property
    def final(self) -> list[torch.Tensor]:
        """The observations by group after the last step, before any reset."""
        return [self._env.final_obs_groups[group] for group in self._groups]

    @property
    def count(self) -> int:
        """Number of groups."""
        return len(self._groups)

    def formed(self, values: list[Any]) -> Any:
        """Combine the groups' values into one observation, an array or a dict."""
        return dict(zip(self._groups, values, strict=True)) if self.dict_obs else values[0]

    def rows(self, values: list[np.ndarray]) -> list[Any]:
        """Split arrays of the groups, (worlds, group size), into one observation per world."""
        return [self.formed(list(row)) for row in zip(*values, strict=True)]


class HostArrays:
    """Transfers actions and results between NumPy arrays and an environment's buffers.

    Args:
        copy: Whether to copy results. Otherwise results on the CPU are live buffers.
        one_world: Whether actions have the shape (nact,) instead of (nworld, nact).
    """

    def __init__(self, env: Env, *, copy: bool = True, one_world: bool = False) -> None:
        self._env, self._copy = env, copy
        # stage the actions in pinned memory on a GPU
        pinned = torch.empty(env.action.shape, pin_memory=True) if env.action.is_cuda else None
        self._pinned = pinned
        actions = (env.action if pinned is None else pinned).numpy()
        self._action = actions[0] if one_world else actions

    def set_action(self, action: Any) -> None:
        """Copy actions into the environment, (nworld, nact) or (nact,), float32 or float64."""
        if not isinstance(action, np.ndarray) or action.shape != self._action.shape or action.dtype.kind != "f":
            numpy = isinstance(action, np.ndarray)
            given = f"a {action.dtype} array of shape {action.shape}" if numpy else described(action)
            raise ValueError(f"actions must be a float32 array of shape {self._action.shape}, not {given}")
        np.copyto(self._action, action, casting="same_kind")
        if self._pinned is not None:
            self._env.action.copy_(self._pinned, non_blocking=True)

    def of(self, *tensors: torch.Tensor) -> list[np.ndarray]:
        """Convert tensors to NumPy arrays, waiting for the device at most once."""
        if self._pinned is None:
            return [tensor.numpy().copy() if self._copy else tensor.numpy() for tensor in tensors]
        copies = [tensor.to("cpu", non_blocking=True) for tensor in tensors]
        torch.cuda.current_stream(self._env.action.device).synchronize()
        return [copy.numpy() for copy in copies]


class Infos:
    """Collects the infos of a step in a dict."""

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
        """Return the buffers of all infos."""
        return [*self._plain.values(), *self._metrics.values()]

    def named(self, values: list[Any]) -> dict[str, Any]:
        """Make a dict of infos from values in the order of ``tensors``."""
        infos = dict(zip(self._plain, values, strict=False))
        for name, table in zip(self._metrics, values[len(self._plain) :], strict=True):
            infos[name] = dict(zip(self._names, table.T, strict=True))
        return infos


class StepResults:
    """Returns the results of a step in Gymnasium's format.

    Args:
        given: Converts all buffers at once to arrays or tensors for the caller.
    """

    def __init__(self, env: Env, observations: Observations, given: Callable[..., list[Any]]) -> None:
        self._env, self._observations, self._infos, self._given = env, observations, Infos(env), given

    def __call__(self) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Return observations, rewards, terminations, truncations and infos."""
        shown = self._observations.current
        env = self._env
        values = iter(self._given(*shown, env.reward, env.terminated, env.truncated, *self._infos.tensors))
        obs = self._observations.formed(list(islice(values, len(shown))))
        reward, terminated, truncated = islice(values, 3)
        return obs, reward, terminated, truncated, self._infos.named(list(values))
