"""Adapt many worlds to Gymnasium's VectorEnv."""

from typing import Any

import gymnasium
import numpy as np
import torch

from lyceum_warp.adapters.adapted_env import ResetSeeds, environment_of, per_world, pictures_of
from lyceum_warp.adapters.gymnasium_spaces import box, observation_space
from lyceum_warp.adapters.step_results import HostArrays, Observations, StepResults
from lyceum_warp.env import Env
from lyceum_warp.support.validate import check_tensor, described
from lyceum_warp.task import Task
from lyceum_warp.viz.cameras import CameraChoice

AutoresetMode = gymnasium.vector.AutoresetMode


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Many worlds as a ``gymnasium.vector.VectorEnv``.

    ``infos`` has ``eval`` and ``done_reason``, as arrays with one value per world. It also has ``success``, ``metrics``
    and ``episode_metrics`` if the task defines them.

    ``autoreset_mode`` says when a world is reset after its episode ends:

    - SAME_STEP resets the world within that step. The world returns the first observation of its next episode.
      ``infos["final_obs"]`` and ``infos["final_info"]`` have the last observations and infos of ended episodes. The
      masks ``_final_obs`` and ``_final_info`` mark the worlds whose episodes ended. If ``torch`` is False,
      ``final_obs`` and ``final_info`` exist only if an episode ended. ``final_obs`` is then an object array with None
      for the other worlds, as Gymnasium's wrappers expect. If ``torch`` is True, they are tensors over all worlds and
      always exist. A check would wait for the device.
    - DISABLED resets worlds only in ``reset(options={"reset_mask": mask})``. Until then, a world keeps stepping, and
      its termination or truncation stays True. A world with a fault is reset at once, but returns its last valid
      observation.
    - NEXT_STEP resets the world in the next step, which ignores the world's action. Every step then runs the kernels of
      a reset twice. Some wrappers, such as ``NormalizeObservation``, require this mode.

    Without a seed for the constructor or the first reset, the seed is random, as in Gymnasium's own environments. One
    seed is enough for all worlds: each world has its own random numbers.

    Args:
        task: A task, as in ``lw.make``, or an environment.
        num_envs: Number of worlds.
        autoreset_mode: A ``gymnasium.vector.AutoresetMode`` or its value. By default SAME_STEP, or DISABLED for an
            environment with ``autoreset=False``.
        torch: Whether actions and results are tensors on the environment's device instead of NumPy arrays. With
            tensors, a step never waits for the device.
        copy: Whether to copy results. Without copies, most results are live buffers, which the next step overwrites.
        dict_obs: Whether observations are dicts of all observation groups instead of the group ``policy``. By default,
            True if the task has several groups.
        render_mode: "rgb_array" for pictures, or None.
        camera: The camera for pictures, as in ``lyceum_warp.viz.video.write_video``.
        render_size: Width and height of pictures in pixels, even numbers.
        max_episode_steps: Steps after which an episode is truncated; by default the task's horizon.
        **words: Options and parameters for ``lw.make``, such as ``device="cuda"`` or ``ctrl_cost_weight=1e-2``.

    Raises:
        FileNotFoundError: The package with the task's model is not installed.
    """

    def __init__(
        self,
        task: str | type[Task] | Env,
        num_envs: int | None = None,
        *,
        autoreset_mode: gymnasium.vector.AutoresetMode | str | None = None,
        torch: bool = False,
        copy: bool = True,
        dict_obs: bool | None = None,
        render_mode: str | None = None,
        camera: CameraChoice = None,
        render_size: tuple[int, int] = (480, 480),
        max_episode_steps: int | None = None,
        **words: Any,
    ) -> None:
        if autoreset_mode is None:
            made_without = isinstance(task, Env) and not task.autoreset
            autoreset_mode = AutoresetMode.DISABLED if made_without else AutoresetMode.SAME_STEP
        try:
            self.autoreset_mode = AutoresetMode(autoreset_mode)
        except ValueError:
            known = ", ".join(mode.value for mode in AutoresetMode)
            raise ValueError(f"there is no autoreset_mode {autoreset_mode!r}: use one of {known}") from None
        if max_episode_steps is not None:
            words["horizon"] = max_episode_steps
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        self.env = environment_of(task, num_envs, words, autoreset=same_step)
        self.num_envs = self.env.nworld
        self.render_mode = render_mode
        self._pictures, metadata = pictures_of(self.env, render_mode, camera, render_size)
        self.metadata = metadata | {"autoreset_mode": self.autoreset_mode}
        self._observations = Observations(self.env, dict_obs=dict_obs)
        self.single_observation_space = observation_space(self.env, dict_obs=self._observations.dict_obs)
        self.single_action_space = box(self.env.action_space)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self._host = None if torch else HostArrays(self.env, copy=copy)
        self._copy = copy
        self._results = StepResults(self.env, self._observations, self._given)
        self._seeds = ResetSeeds(seeded=isinstance(task, Env) or "seed" in words)
        self._ended = self.env.done.clone()
        self._reset_once = False

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        return self.env.obs.device

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start new random episodes.

        Args:
            seed: Seed of the worlds' random streams; None continues them.
            options: ``{"reset_mask": mask}`` resets only the worlds in the mask, (num_envs,) bool.

        Returns:
            The observations and infos of all worlds.

        Raises:
            ResetNeeded: A partial reset came before the first full reset.
            ValueError: The seed is not a whole number, or an option is unknown or has the wrong shape or type.
        """
        mask = self._mask(options)
        own_seed = self._seeds(seed, lambda: self.np_random_seed)
        super().reset(seed=seed)
        self.env.rand_reset(own_seed, mask)
        self._ended.copy_(self.env.done)
        self._reset_once = True
        obs, *_, infos = self._results()
        return obs, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Advance every world by one step.

        Args:
            actions: (num_envs, nact), a float32 array; with ``torch=True``, a tensor on the environment's device.

        Raises:
            ResetNeeded: ``reset`` was not called yet.
            ValueError: The actions have the wrong shape, type or device.
        """
        if not self._reset_once:
            raise gymnasium.error.ResetNeeded("there was no reset before this step: call reset() first")
        env = self.env
        if self._host is None:
            env.action.copy_(_tensor(actions, env.action).detach())
        else:
            self._host.set_action(actions)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            env.action.masked_fill_(self._ended[:, None], 0.0)  # a NaN in an ignored action is not a fault
        env.step()
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            env.rand_reset(mask=self._ended)
            self._ended.copy_(env.done)
        obs, rewards, terminations, truncations, infos = self._results()
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            self._add_final(infos, terminations | truncations)
        return obs, rewards, terminations, truncations, infos

    def render(self) -> tuple[Any, ...] | None:
        """Render a picture of each world, (height, width, 3) uint8; None if ``render_mode`` is None.

        Raises:
            NoVideoError: This machine cannot render.
        """
        return None if self.render_mode is None else tuple(self._pictures())

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Call a method or read an attribute of this adapter or its ``Env``. Return one value per world.

        A tensor with one row per world is split into rows. Any other value is repeated.
        """
        value = getattr(self if hasattr(self, name) else self.env, name)
        value = value(*args, **kwargs) if callable(value) else value
        if isinstance(value, tuple) and name == "render":
            return value
        return tuple(per_world(value, self.num_envs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """The value of an attribute for each world; see ``call``."""
        return self.call(name)

    def close_extras(self, **kwargs: Any) -> None:
        """End the rendering subprocess."""
        if hasattr(self, "_pictures"):  # Gymnasium also closes an environment whose constructor failed
            self._pictures.close()

    def _given(self, *buffers: torch.Tensor) -> list[Any]:
        if self._host is not None:
            return list(self._host.of(*buffers))
        return [buffer.clone() for buffer in buffers] if self._copy else list(buffers)

    def _add_final(self, infos: dict[str, Any], ended: Any) -> None:
        final_info = dict(infos)
        if self._host is None:
            final_obs = self._observations.formed(self._given(*self._observations.final))
        elif ended.any():
            final_obs = self._rows_of_ended(ended)
        else:
            return
        infos |= {"final_obs": final_obs, "_final_obs": ended, "final_info": final_info, "_final_info": ended}

    def _rows_of_ended(self, ended: np.ndarray) -> np.ndarray:
        """Return the final observation of each ended world, and None for each other world."""
        (worlds,) = ended.nonzero()
        index = torch.from_numpy(worlds).to(self.device)
        values = self._given(*(final[index] for final in self._observations.final))
        rows = np.full(self.num_envs, None, dtype=object)
        for world, row in zip(worlds, self._observations.rows(values), strict=True):
            rows[world] = row
        return rows

    def _mask(self, options: dict[str, Any] | None) -> torch.Tensor | None:
        if unknown := [name for name in options or {} if name != "reset_mask"]:
            raise ValueError(f'reset has no option {unknown[0]!r}: it takes options={{"reset_mask": mask}}')
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return None
        if isinstance(mask, np.ndarray) and mask.dtype == bool:
            mask = torch.from_numpy(mask).to(self.device)
        check_tensor(mask, "the reset_mask", self.env.done)
        if not self._reset_once:
            raise gymnasium.error.ResetNeeded("the first reset cannot have a reset_mask: call reset() first")
        return mask


def _tensor(actions: Any, like: torch.Tensor) -> torch.Tensor:
    if not isinstance(actions, torch.Tensor):
        raise ValueError(f"actions must be {described(like)}, not {described(actions)}, because of torch=True")
    check_tensor(actions, "actions", like)
    return actions
