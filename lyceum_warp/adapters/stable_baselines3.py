"""Adapt many worlds to Stable-Baselines3's VecEnv."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from lyceum_warp.adapters.adapted_env import per_world
from lyceum_warp.adapters.gymnasium_vector import GymnasiumVectorEnv
from lyceum_warp.core import Task
from lyceum_warp.env import Env

try:
    from stable_baselines3.common.monitor import Monitor
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    install = "pip install 'lyceum-warp[stable-baselines3]'"
    raise ImportError(f"this adapter needs the package stable-baselines3: {install}") from error


class StableBaselines3VecEnv(VecEnv):
    """Many worlds as a ``stable_baselines3.common.vec_env.VecEnv``.

    When a world's episode ends, its info dict has ``terminal_observation``, ``TimeLimit.truncated``, ``eval``,
    ``done_reason`` and ``episode``. As in Stable-Baselines3's Monitor, ``episode`` has the return ``r``, the length
    ``l`` and the seconds since the start ``t``. A task with a goal adds ``is_success``, and a task with metrics adds
    ``episode_metrics``. The info dicts of all other worlds are empty.

    By default, observations contain only the group ``policy``. Stable-Baselines3 would feed any other group to the
    policy, too.

    Args:
        task: A task, as in ``lw.make``, or an ``Env``.
        num_envs: Number of worlds; by default one, or the number in the given environment.
        dict_obs: Whether observations are dicts of all observation groups.
        **options: ``render_mode``, ``camera`` and ``render_size``, as in ``GymnasiumVectorEnv``. All others are options
            and parameters for ``lw.make``.

    Raises:
        FileNotFoundError: The package with the task's model is not installed.
    """

    def __init__(
        self, task: str | type[Task] | Env, num_envs: int | None = None, *, dict_obs: bool = False, **options: Any
    ) -> None:
        self._worlds = worlds = GymnasiumVectorEnv(
            task, num_envs, autoreset_mode=AutoresetMode.SAME_STEP, dict_obs=dict_obs, **options
        )
        self.env, self.render_mode = worlds.env, worlds.render_mode  # VecEnv's constructor reads render_mode
        super().__init__(worlds.num_envs, worlds.single_observation_space, worlds.single_action_space)
        self.metadata: dict[str, Any] = {**self.metadata, **worlds.metadata}
        self._returns, self._lengths = np.zeros(self.num_envs), np.zeros(self.num_envs, dtype=int)
        self._start = time.time()

    def reset(self) -> Any:
        """Start new random episodes in all worlds, and return the first observations.

        Raises:
            ValueError: Options were set by ``set_options``; ``reset`` supports no options.
        """
        if options := next(filter(None, self._options), None):
            raise ValueError(f"reset has no option {next(iter(options))!r}: do not call set_options")
        obs, _ = self._worlds.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Set the actions of the next step, (num_envs, nact), float32."""
        self._actions = actions

    def step_wait(self) -> Any:
        """Advance every world by one step.

        Raises:
            ResetNeeded: ``reset`` was not called yet.
            ValueError: The actions have the wrong shape or type.
        """
        obs, rewards, terminations, truncations, infos = self._worlds.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        done = terminations | truncations
        dicts: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if done.any():
            final, seconds = infos["final_info"], round(time.time() - self._start, 6)
            final.pop("metrics", None)
            for world in done.nonzero()[0].tolist():
                dicts[world] = {
                    "terminal_observation": infos["final_obs"][world],
                    "TimeLimit.truncated": not terminations[world],
                    "episode": {"r": self._returns[world].item(), "l": self._lengths[world].item(), "t": seconds},
                    **_of_world(final, world),
                }
            self._returns[done], self._lengths[done] = 0.0, 0
        return obs, rewards, done, dicts

    def close(self) -> None:
        """End the rendering subprocess."""
        self._worlds.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Render a picture of each world, (height, width, 3) uint8. Return a list of None if ``render_mode`` is None.

        Raises:
            NoVideoError: This machine cannot render.
        """
        return self._worlds.render() or [None] * self.num_envs

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Read a parameter of the task, or an attribute of the ``Env`` or of this adapter, for each world.

        A tensor with one row per world is split into rows. Any other value is repeated.
        """
        parameters = self.env.task.parameters
        if attr_name in parameters.values:
            value = parameters.values[attr_name]
            rows = list(value) if attr_name in parameters.per_world else [value] * self.num_envs
            return [rows[i] for i in self._get_indices(indices)]
        return self._values(getattr(self.env if hasattr(self.env, attr_name) else self, attr_name), indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set a parameter of the task in all worlds, or an attribute of this adapter.

        Raises:
            ValueError: There is no such parameter or attribute, or ``indices`` selects only some worlds.
        """
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"{attr_name!r} is shared by all worlds: call set_attr without indices")
        if attr_name not in self.env.task.parameters.values and hasattr(self, attr_name):
            setattr(self, attr_name, value)
        else:  # if the name is unknown, the error suggests similar names
            self.env.set_params(**{attr_name: value})

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the ``Env`` once, and return its result for each world, as ``get_attr`` does."""
        return self._values(getattr(self.env, method_name)(*method_args, **method_kwargs), indices)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return True for Monitor, because this adapter provides its statistics, and False for any other wrapper."""
        return self._values(wrapper_class is Monitor, indices)

    def _values(self, value: Any, indices: Any) -> list[Any]:
        rows = per_world(value, self.num_envs)
        return [rows[i] for i in self._get_indices(indices)]


def _of_world(infos: dict[str, Any], i: int) -> dict[str, Any]:
    return {
        "is_success" if name == "success" else name: _of_world(value, i) if isinstance(value, dict) else value[i].item()
        for name, value in infos.items()
    }
