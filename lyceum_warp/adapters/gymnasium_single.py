"""Adapt one world to Gymnasium's Env."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode

from lyceum_warp.adapters.gymnasium_vector import GymnasiumVectorEnv, check_array
from lyceum_warp.core import Task
from lyceum_warp.env import Env


class GymnasiumEnv(gymnasium.Env[Any, np.ndarray]):
    """One world as a ``gymnasium.Env``, for evaluation, debugging and tools that need a single environment.

    ``info`` has ``eval`` and ``done_reason``. It also has ``success``, ``metrics`` and ``episode_metrics`` if the task
    defines them. For many worlds, ``GymnasiumVectorEnv`` is much faster.

    Args:
        task: A task, as in ``lw.make``, or an environment with one world, made with ``autoreset=False``.
        **options: ``dict_obs``, ``render_mode``, ``camera`` and ``render_size``, as in ``GymnasiumVectorEnv``. All
            others are options and parameters for ``lw.make``.

    Raises:
        FileNotFoundError: The package with the task's model is not installed.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}  # type: ignore[misc]

    def __init__(self, task: str | type[Task] | Env, **options: Any) -> None:
        self._worlds = GymnasiumVectorEnv(task, 1, autoreset_mode=AutoresetMode.DISABLED, **options)
        self.env = self._worlds.env
        self.render_mode, self.metadata = self._worlds.render_mode, self._worlds.metadata  # type: ignore[misc]
        self.observation_space = self._worlds.single_observation_space
        self.action_space = self._worlds.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start a new random episode.

        Args:
            seed: Seed of the random stream; None continues it.
            options: Must be None or empty.

        Raises:
            ValueError: The seed is not a whole number, or ``options`` is not empty.
        """
        if options:
            raise ValueError(f"reset has no option {next(iter(options))!r}: call it without options")
        obs, info = self._worlds.reset(seed=seed)
        super().reset(seed=seed)
        return _row(obs), _numbers(info)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance the world by one step.

        Args:
            action: (nact,), float32.

        Raises:
            ResetNeeded: ``reset`` was not called yet.
            ValueError: The action has the wrong shape or type.
        """
        check_array(action, self.env.action_space.shape)
        obs, reward, terminated, truncated, info = self._worlds.step(action[None])
        return _row(obs), float(reward[0]), bool(terminated[0]), bool(truncated[0]), _numbers(info)

    def render(self) -> Any:
        """Render a picture of the world, (height, width, 3) uint8; None if ``render_mode`` is None.

        Raises:
            NoVideoError: This machine cannot render.
        """
        pictures = self._worlds.render()
        return pictures and pictures[0]

    def close(self) -> None:
        """End the rendering subprocess."""
        self._worlds.close()


def _row(obs: Any) -> Any:
    return {group: rows[0] for group, rows in obs.items()} if isinstance(obs, dict) else obs[0]


def _numbers(info: dict[str, Any]) -> dict[str, Any]:
    return {name: _numbers(value) if isinstance(value, dict) else value.item() for name, value in info.items()}
