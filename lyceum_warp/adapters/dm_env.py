"""Adapt one world to dm_env's Environment, the interface of dm_control's suite."""

from typing import Any

import numpy as np
import torch

from lyceum_warp.adapters.adapted_env import ResetSeeds, environment_of
from lyceum_warp.adapters.step_results import HostArrays, Observations
from lyceum_warp.env import Env
from lyceum_warp.task import Task

try:
    import dm_env
    from dm_env import specs
except ImportError as error:
    raise ImportError("this adapter needs the package dm-env: pip install 'dm-env>=1.5,<2'") from error


class DmEnvironment(dm_env.Environment):  # type: ignore[misc]
    """One world as a ``dm_env.Environment``, for code that expects the interface of dm_control's suite.

    An observation is a dict with the parts of the observation group ``policy``, float32. A single number has the shape
    (1,). The first step after the end of an episode ignores its action and starts a new episode. The discount is 0
    after a termination. It is 1 if a time limit or a fault ends the episode.

    Args:
        task: A task, as in ``lw.make``, or an environment with one world, made with ``autoreset=False``.
        flat_observation: Whether an observation is a dict with a single array, "observations".
        **words: Options and parameters for ``lw.make``; ``seed=0`` gives the same episodes in every run.

    Raises:
        FileNotFoundError: The package with the task's model is not installed.
    """

    def __init__(self, task: str | type[Task] | Env, *, flat_observation: bool = False, **words: Any) -> None:
        self.env = environment_of(task, 1, words, autoreset=False)
        self._parts = {"observations": slice(None)} if flat_observation else self.env.obs_space.parts
        self._observations = Observations(self.env, dict_obs=False)
        self._host = HostArrays(self.env, one_world=True)
        self._seeds = ResetSeeds(seeded=isinstance(task, Env) or "seed" in words)
        self._ended = True

    def reset(self) -> dm_env.TimeStep:
        """Start a new random episode. Reward and discount of its first time step are None."""
        self.env.rand_reset(self._seeds(None, lambda: np.random.SeedSequence().entropy))
        self._ended = False
        (obs,) = self._host.of(self.env.obs)
        return dm_env.restart(self._split(obs[0]))

    def step(self, action: np.ndarray) -> dm_env.TimeStep:
        """Advance the world by one step, or start the next episode.

        Args:
            action: (nact,), float32 or float64.

        Raises:
            ValueError: The action has the wrong shape or type.
        """
        if self._ended:
            return self.reset()
        self._host.set_action(action)
        env = self.env
        env.step()
        buffers: list[torch.Tensor] = [*self._observations.current, env.reward, env.terminated, env.truncated]
        obs, reward, terminated, truncated = (array[0] for array in self._host.of(*buffers))
        self._ended = bool(terminated or truncated)
        if terminated:
            return dm_env.termination(float(reward), self._split(obs))
        if truncated:
            return dm_env.truncation(float(reward), self._split(obs))
        return dm_env.transition(float(reward), self._split(obs))

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
