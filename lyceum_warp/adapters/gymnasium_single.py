"""Adapt one world to Gymnasium's Env."""

from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch

from lyceum_warp.adapters.adapted_env import ResetSeeds, environment_of, pictures_of
from lyceum_warp.adapters.gymnasium_spaces import box, observation_space
from lyceum_warp.adapters.step_results import HostArrays, Observations, StepResults
from lyceum_warp.env import Env
from lyceum_warp.task import Task
from lyceum_warp.viz.cameras import CameraChoice


class GymnasiumEnv(gymnasium.Env[Any, np.ndarray]):
    """One world as a ``gymnasium.Env``, for evaluation, debugging and tools that need a single environment.

    ``info`` has ``eval`` and ``done_reason``. It also has ``success``, ``metrics`` and ``episode_metrics`` if the task
    defines them. For many worlds, ``GymnasiumVectorEnv`` is much faster.

    Args:
        task: A task, as in ``lw.make``, or an environment with one world, made with ``autoreset=False``.
        dict_obs: Whether observations are dicts of all observation groups instead of the group ``policy``. By default,
            True if the task has several groups.
        render_mode: "rgb_array" for pictures, or None.
        camera: The camera for pictures, as in ``lyceum_warp.viz.video.write_video``.
        render_size: Width and height of pictures in pixels, even numbers.
        **words: Options and parameters for ``lw.make``.

    Raises:
        FileNotFoundError: The package with the task's model is not installed.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"]}  # type: ignore[misc]

    def __init__(
        self,
        task: str | type[Task] | Env,
        *,
        dict_obs: bool | None = None,
        render_mode: str | None = None,
        camera: CameraChoice = None,
        render_size: tuple[int, int] = (480, 480),
        **words: Any,
    ) -> None:
        self.env = environment_of(task, 1, words, autoreset=False)
        self.render_mode = render_mode
        self._pictures, self.metadata = pictures_of(self.env, render_mode, camera, render_size)  # type: ignore[misc]
        self._observations = Observations(self.env, dict_obs=dict_obs)
        self.observation_space = observation_space(self.env, dict_obs=self._observations.dict_obs)
        self.action_space = box(self.env.action_space)
        self._host = HostArrays(self.env, one_world=True)
        self._results = StepResults(self.env, self._observations, self._rows)
        self._seeds = ResetSeeds(seeded=isinstance(task, Env) or "seed" in words)
        self._reset_once = False

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
        own_seed = self._seeds(seed, lambda: self.np_random_seed)
        super().reset(seed=seed)
        self.env.rand_reset(own_seed)
        self._reset_once = True
        obs, *_, info = self._results()
        return obs, _numbers(info)

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advance the world by one step.

        Args:
            action: (nact,), float32.

        Raises:
            ResetNeeded: ``reset`` was not called yet.
            ValueError: The action has the wrong shape or type.
        """
        if not self._reset_once:
            raise gymnasium.error.ResetNeeded("there was no reset before this step: call reset() first")
        self._host.set_action(action)
        self.env.step()
        obs, reward, terminated, truncated, info = self._results()
        return obs, float(reward), bool(terminated), bool(truncated), _numbers(info)

    def render(self) -> Any:
        """Render a picture of the world, (height, width, 3) uint8; None if ``render_mode`` is None.

        Raises:
            NoVideoError: This machine cannot render.
        """
        return None if self.render_mode is None else self._pictures()[0]

    def close(self) -> None:
        """End the rendering subprocess."""
        self._pictures.close()

    def _rows(self, *buffers: torch.Tensor) -> list[Any]:
        return [array[0] for array in self._host.of(*buffers)]


def _numbers(info: dict[str, Any]) -> dict[str, Any]:
    return {name: _numbers(value) if isinstance(value, dict) else value.item() for name, value in info.items()}
