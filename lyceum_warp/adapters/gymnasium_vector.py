"""Adapt many worlds to Gymnasium's VectorEnv."""

from collections.abc import Callable
from operator import itemgetter
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from lyceum_warp.adapters.adapted_env import environment_of, per_world
from lyceum_warp.core import Space, Task
from lyceum_warp.env import Env
from lyceum_warp.support.arrays import torch_view
from lyceum_warp.support.tensors import check_tensor
from lyceum_warp.support.validate import described, whole_number
from lyceum_warp.viz import CameraChoice, WorldPictures


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """Many worlds as a ``gymnasium.vector.VectorEnv``.

    ``infos`` has ``eval`` and ``done_reason``, as arrays with one value per world. It also has ``success``, ``metrics``
    and ``episode_metrics`` if the task defines them.

    ``autoreset_mode`` says when a world is reset after its episode ends:

    - SAME_STEP resets the world within that step. The world returns the first observation of its next episode.
      ``infos["final_obs"]`` and ``infos["final_info"]`` have the last observations and infos of ended episodes. The
      masks ``_final_obs`` and ``_final_info`` mark the worlds whose episodes ended. With ``torch``, ``final_obs`` and
      ``final_info`` always exist, as tensors over all worlds. Omitting them would require a wait for the device.
      Without ``torch``, a step that ends no episode omits both. Otherwise, ``final_obs`` is an object array with None
      for worlds whose episodes continue, as Gymnasium's wrappers expect.
    - DISABLED resets worlds only in ``reset(options={"reset_mask": mask})``. Until then, a world keeps stepping, and
      its termination or truncation stays True. A world with a fault is reset at once, but returns its last valid
      observation.
    - NEXT_STEP resets the world in the next step, which ignores the world's action. Every step then runs the kernels of
      a reset twice. Some wrappers, such as ``NormalizeObservation``, require this mode.

    If neither the constructor nor the first reset gets a seed, the seed is random, as in Gymnasium's own environments.
    One seed is enough for all worlds: each world has its own random numbers.

    Args:
        task: A task, as in ``lw.make``, or an environment.
        num_envs: Number of worlds.
        autoreset_mode: A ``gymnasium.vector.AutoresetMode`` or its value. By default SAME_STEP, or DISABLED for an
            environment with ``autoreset=False``.
        torch: Whether actions and results are tensors on the environment's device instead of NumPy arrays. With
            tensors, a step never waits for the device.
        copy: Whether to copy results. Without copies, most results are live buffers, which the next step overwrites.
        dict_obs: Whether observations are dicts of all observation groups instead of the group ``policy``. By default,
            this is True if the task has several groups.
        render_mode: "rgb_array" for pictures, or None.
        camera: The camera for pictures, as in ``lyceum_warp.viz.video.write_video``.
        render_size: Width and height of pictures in pixels, even numbers.
        max_episode_steps: Steps after which an episode is truncated; by default the task's horizon.
        **options: Options and parameters for ``lw.make``, such as ``device="cuda"`` or ``ctrl_cost_weight=1e-2``.

    Raises:
        FileNotFoundError: The package with the task's model is not installed.
    """

    def __init__(
        self,
        task: str | type[Task] | Env,
        num_envs: int | None = None,
        *,
        autoreset_mode: AutoresetMode | str | None = None,
        torch: bool = False,
        copy: bool = True,
        dict_obs: bool | None = None,
        render_mode: str | None = None,
        camera: CameraChoice = None,
        render_size: tuple[int, int] = (480, 480),
        max_episode_steps: int | None = None,
        **options: Any,
    ) -> None:
        if autoreset_mode is None:
            disabled = isinstance(task, Env) and not task.autoreset
            autoreset_mode = AutoresetMode.DISABLED if disabled else AutoresetMode.SAME_STEP
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"there is no render_mode {render_mode!r}: use 'rgb_array', or None for no pictures")
        if max_episode_steps is not None:
            options["horizon"] = max_episode_steps
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        if same_step and not isinstance(task, Env):
            options.setdefault("final_pictures", True)  # infos have the final observations
        self.env = env = environment_of(task, num_envs, options, autoreset=same_step)
        self.num_envs = env.nworld
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": ["rgb_array"], "render_fps": max(1, round(1 / env.timestep)),
            "autoreset_mode": self.autoreset_mode,
        }  # fmt: skip
        self._pictures = WorldPictures(env, camera=camera, size=render_size)
        self._dict_obs = len(env.obs_groups) > 1 if dict_obs is None else dict_obs
        groups: dict[str, gymnasium.Space[Any]] = {name: _box(space) for name, space in env.obs_spaces.items()}
        self.single_observation_space = gymnasium.spaces.Dict(groups) if self._dict_obs else groups["policy"]
        self.single_action_space = _box(env.action_space)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._torch, self._copy = torch, copy
        self._seeded = isinstance(task, Env) or "seed" in options
        self._ended = env.done.clone()
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
        world_seed = None
        if seed is not None or not self._seeded:
            value = self.np_random_seed if seed is None else seed
            world_seed = whole_number("seed", value, low=0, high=2**128) % 2**31
        self._seeded = True
        super().reset(seed=seed)
        self.env.rand_reset(world_seed, mask)
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
        if self._torch:
            check_tensor(actions, "actions", env.action)
            env.action.copy_(actions.detach())
        else:
            check_array(actions, env.action.shape)
            env.action.copy_(torch.from_numpy(actions.astype(np.float32)))
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

    def _results(self) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Return observations, rewards, terminations, truncations and infos, in one transfer from the device."""
        env = self.env
        groups, infos = dict(env.obs_groups), {"eval": env.eval, "done_reason": env.done_reason}
        if not env.autoreset:
            # a world with a fault has already restarted, so its final observation is in final_obs
            done = env.done[:, None]
            rows = {name: final for name, final in env.final_obs_groups.items() if final.ndim == 2}
            groups |= {name: torch.where(done, final, groups[name]) for name, final in rows.items()}
        if env.task.functions["success"] is not None:
            infos["success"] = env.success
        tables = {}
        if env.metrics:
            tables = {"metrics": torch_view(env.worlds.metrics), "episode_metrics": env.episode_metric_sums}
        results = self._converted({
            "obs": self._observation(groups), "reward": env.reward, "terminated": env.terminated,
            "truncated": env.truncated, "infos": infos, "tables": tables,
        })  # fmt: skip
        for name, table in results.pop("tables").items():
            results["infos"][name] = dict(zip(env.metrics, table.T, strict=True))
        return tuple(results.values())

    def _observation(self, groups: Any) -> Any:
        return dict(groups) if self._dict_obs else groups["policy"]

    def _converted(self, buffers: Any) -> Any:
        """Convert buffers in nested dicts to arrays or tensors for the caller."""
        if self._torch:
            return _mapped(buffers, lambda buffer: buffer.clone() if self._copy else buffer)
        if not self.env.action.is_cuda:
            return _mapped(buffers, lambda buffer: buffer.numpy().copy() if self._copy else buffer.numpy())
        copies = _mapped(buffers, lambda buffer: buffer.to("cpu", non_blocking=True))
        torch.cuda.current_stream(self.device).synchronize()
        return _mapped(copies, torch.Tensor.numpy)

    def _add_final(self, infos: dict[str, Any], ended: Any) -> None:
        final_info = dict(infos)
        last = self._observation(self.env.final_obs_groups)
        if self._torch:
            final_obs = self._converted(last)
        elif ended.any():
            (worlds,) = ended.nonzero()
            index = torch.from_numpy(worlds).to(self.device)
            rows = self._converted(_mapped(last, itemgetter(index)))
            final_obs = np.full(self.num_envs, None, dtype=object)
            for i, world in enumerate(worlds):
                final_obs[world] = _mapped(rows, itemgetter(i))
        else:
            return
        infos |= {"final_obs": final_obs, "_final_obs": ended, "final_info": final_info, "_final_info": ended}

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


def check_array(actions: Any, shape: tuple[int, ...]) -> None:
    """Check that actions are an array of floats with the given shape."""
    if not isinstance(actions, np.ndarray) or actions.shape != shape or actions.dtype.kind != "f":
        array = isinstance(actions, np.ndarray)
        text = f"a {actions.dtype} array of shape {actions.shape}" if array else described(actions)
        raise ValueError(f"actions must be a float32 array of shape {tuple(shape)}, not {text}")


def _box(space: Space) -> gymnasium.spaces.Box:
    """Convert a space to a Gymnasium Box."""
    low, high = (-np.inf if space.low is None else space.low), (np.inf if space.high is None else space.high)
    return gymnasium.spaces.Box(low, high, shape=space.shape, dtype=np.dtype(str(space.dtype).partition(".")[2]).type)


def _mapped(values: Any, function: Callable[[Any], Any]) -> Any:
    """Apply a function to the values in nested dicts."""
    if isinstance(values, dict):
        return {name: _mapped(value, function) for name, value in values.items()}
    return function(values)
