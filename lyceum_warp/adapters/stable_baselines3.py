"""Adapt many worlds to Stable-Baselines3's VecEnv."""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from lyceum_warp.adapters.adapted_env import ResetSeeds, environment_of, per_world, pictures_of
from lyceum_warp.adapters.gymnasium_spaces import box, observation_space
from lyceum_warp.adapters.step_results import HostArrays, Infos, Observations
from lyceum_warp.env import Env
from lyceum_warp.task import Task
from lyceum_warp.viz.cameras import CameraChoice

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

    Observations are by default only the group ``policy``, because Stable-Baselines3 would feed all groups to the
    policy.

    Args:
        task: A task, as in ``lw.make``, or an ``Env``.
        num_envs: Number of worlds; by default one, or the number in the given environment.
        dict_obs: Whether observations are dicts of all observation groups.
        render_mode: "rgb_array" for pictures, or None.
        camera: The camera for pictures, as in ``lyceum_warp.viz.video.write_video``.
        render_size: Width and height of pictures in pixels, even numbers.
        **words: Options and parameters for ``lw.make``.

    Raises:
        FileNotFoundError: The package with the task's model is not installed.
    """

    def __init__(
        self,
        task: str | type[Task] | Env,
        num_envs: int | None = None,
        *,
        dict_obs: bool = False,
        render_mode: str | None = None,
        camera: CameraChoice = None,
        render_size: tuple[int, int] = (480, 480),
        **words: Any,
    ) -> None:
        self.render_mode = render_mode  # VecEnv's constructor reads render_mode
        self.env = env = environment_of(task, num_envs, words, autoreset=True)
        self._pictures, metadata = pictures_of(env, render_mode, camera, render_size)
        self._observations = Observations(env, dict_obs=dict_obs)
        self._host, self._infos = HostArrays(env), Infos(env)
        super().__init__(env.nworld, observation_space(env, dict_obs=dict_obs), box(env.action_space))
        self.metadata: dict[str, Any] = {**self.metadata, **metadata}
        self._own_seeds = ResetSeeds(seeded=isinstance(task, Env) or "seed" in words)
        self._returns, self._lengths = np.zeros(env.nworld), np.zeros(env.nworld, dtype=int)
        self._no_infos: list[dict[str, Any]] = [{} for _ in range(env.nworld)]
        self._start = time.time()
        self._reset_once = False

    def reset(self) -> Any:
        """Start new random episodes in all worlds, and return the first observations.

        Raises:
            ValueError: Options were set by ``set_options``; ``reset`` supports no options.
        """
        if options := next(filter(None, self._options), None):
            raise ValueError(f"reset has no option {next(iter(options))!r}: do not call set_options")
        seed = self._own_seeds(self._seeds[0], lambda: int(np.random.randint(2**31 - 1)))
        self.env.rand_reset(seed)
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        self._reset_once = True
        return self._observations.formed(list(self._host.of(*self._observations.current)))

    def step_async(self, actions: np.ndarray) -> None:
        """Set the actions of the next step, (num_envs, nact), float32.

        Raises:
            RuntimeError: ``reset`` was not called yet.
            ValueError: The actions have the wrong shape or type.
        """
        if not self._reset_once:
            raise RuntimeError("there was no reset before this step: call reset() first")
        self._host.set_action(actions)

    def step_wait(self) -> Any:
        """Advance every world by one step."""
        env, count = self.env, self._observations.count
        env.step()
        *values, reward, done = self._host.of(*self._observations.current, env.reward, env.done)
        self._returns += reward
        self._lengths += 1
        infos = self._no_infos.copy()
        if done.any():
            self._add_ends(infos, done.nonzero()[0])
        return self._observations.formed(values[:count]), reward, done, infos

    def close(self) -> None:
        """End the rendering subprocess."""
        self._pictures.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Render a picture of each world, (height, width, 3) uint8. Return a list of None if ``render_mode`` is None.

        Raises:
            NoVideoError: This machine cannot render.
        """
        return [None] * self.num_envs if self.render_mode is None else self._pictures()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Read a parameter of the task, or an attribute of the ``Env`` or of this adapter, for each world.

        A tensor with one row per world is split into rows. Any other value is repeated.
        """
        parameters = self.env.task.parameters
        if attr_name in parameters.values:
            value = parameters.values[attr_name]
            rows = list(value) if attr_name in parameters.per_world else [value] * self.num_envs
            return [rows[i] for i in self._get_indices(indices)]
        return self._chosen(getattr(self.env if hasattr(self.env, attr_name) else self, attr_name), indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set a parameter of the task in all worlds, or an attribute of this adapter.

        Raises:
            ValueError: There is no such parameter or attribute, or ``indices`` selects only some worlds.
        """
        if len(set(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"{attr_name!r} is shared by all worlds: call set_attr without indices")
        if attr_name not in self.env.task.parameters.values and hasattr(self, attr_name):
            setattr(self, attr_name, value)
        else:  # set_params suggests similar names
            self.env.set_params(**{attr_name: value})

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of the ``Env`` once, and return its result for each world, as ``get_attr`` does."""
        return self._chosen(getattr(self.env, method_name)(*method_args, **method_kwargs), indices)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Return True for Monitor, because this adapter provides its statistics, and False for any other wrapper."""
        return self._chosen(wrapper_class is Monitor, indices)

    def _chosen(self, value: Any, indices: Any) -> list[Any]:
        rows = per_world(value, self.num_envs)
        return [rows[i] for i in self._get_indices(indices)]

    def _add_ends(self, infos: list[dict[str, Any]], worlds: np.ndarray) -> None:
        env, count = self.env, self._observations.count
        index = torch.from_numpy(worlds).to(env.obs.device)
        buffers = [*self._observations.final, env.terminated, *self._infos.tensors]
        values = self._host.of(*(buffer[index] for buffer in buffers))
        rows, terminations = self._observations.rows(values[:count]), values[count]
        said = self._infos.named(values[count + 1 :])
        said.pop("metrics", None)
        seconds = round(time.time() - self._start, 6)
        for i, world in enumerate(worlds.tolist()):
            infos[world] = {
                "terminal_observation": rows[i],
                "TimeLimit.truncated": not terminations[i],
                "episode": {"r": self._returns[world].item(), "l": self._lengths[world].item(), "t": seconds},
                **_of_world(said, i),
            }
        self._returns[worlds], self._lengths[worlds] = 0.0, 0


def _of_world(infos: dict[str, Any], i: int) -> dict[str, Any]:
    return {
        "is_success" if name == "success" else name: _of_world(value, i) if isinstance(value, dict) else value[i].item()
        for name, value in infos.items()
    }
