"""Adapt one world to dm_env's Environment, the interface of dm_control's suite."""

from typing import Any

import numpy as np

from lyceum_warp.adapters.gymnasium_single import GymnasiumEnv
from lyceum_warp.core import Task
from lyceum_warp.env import Env

try:
    import dm_env
    from dm_env import specs
except ImportError as error:
    raise ImportError("this adapter needs the package dm-env: pip install 'dm-env>=1.5,<2'") from error


class DmEnvironment(dm_env.Environment):  # type: ignore[misc]
    """One world as a ``dm_env.Environment``, for code that expects the interface of dm_control's suite.

    An observation is a dict with one float32 array for each part of the group ``policy``. A single number has the shape
    (1,). The first step after the end of an episode ignores its action and starts a new episode. The discount is 0
    after a termination. It is 1 if a time limit or a fault ends the episode.

    Args:
        task: A task, as in ``lw.make``, or an environment with one world, made with ``autoreset=False``.
        flat_observation: Whether an observation is a dict with a single array, "observations".
        **options: Options and parameters for ``lw.make``; ``seed=0`` gives the same episodes in every run.

    Raises:
        FileNotFoundError: The package with the task's model is not installed.
    """

    def __init__(self, task: str | type[Task] | Env, *, flat_observation: bool = False, **options: Any) -> None:
        self._world = GymnasiumEnv(task, dict_obs=False, **options)
        self.env = self._world.env
        self._parts = {"observations": slice(None)} if flat_observation else self.env.obs_space.parts
        self._ended = True

    def reset(self) -> dm_env.TimeStep:
        """Start a new random episode. The reward and the discount of the first time step are None."""
        obs, _ = self._world.reset()
        self._ended = False
        return dm_env.restart(self._split(obs))

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Advance the world by one step, or start the next episode.

        Args:
            action: (nact,), float32 or float64.

        Raises:
            ValueError: The action has the wrong shape or type.
        """
        if self._ended:
            return self.reset()
        obs, reward, terminated, truncated, _ = self._world.step(action)
        self._ended = terminated or truncated
        if terminated:
            return dm_env.termination(reward, self._split(obs))
        if truncated:
            return dm_env.truncation(reward, self._split(obs))
        return dm_env.transition(reward, self._split(obs))

    def observation_spec(self) -> dict[str, specs.Array]:
        """Describe the parts of an observation by their shapes."""
        sizes = {name: len(range(*part.indices(self.env.obs_space.size))) for name, part in self._parts.items()}
        return {name: specs.Array((size,), np.float32, name) for name, size in sizes.items()}

    def action_spec(self) -> specs.BoundedArray:
        """Describe the shape and the bounds of an action."""
        space = self.env.action_space
        return specs.BoundedArray(space.shape, np.float32, space.low, space.high, "action")

    def _split(self, obs: np.ndarray) -> dict[str, np.ndarray]:
        return {name: obs[part] for name, part in self._parts.items()}
