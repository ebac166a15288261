"""Many worlds as a vector environment of Gymnasium."""

from typing import Any

import numpy as np
import torch

from lyceum_warp.adapters.adapted_env import ResetSeeds, environment_of, per_world
from lyceum_warp.adapters.gymnasium_library import gymnasium
from lyceum_warp.adapters.gymnasium_spaces import action_space, observation_space
from lyceum_warp.adapters.host_arrays import HostArrays
from lyceum_warp.adapters.rendering import RENDER_MODES, check_render_mode, frame_rate
from lyceum_warp.adapters.step_results import Observations, StepResults
from lyceum_warp.env import Env
from lyceum_warp.support.validate import check_tensor, described
from lyceum_warp.task import Task
from lyceum_warp.viz.cameras import CameraChoice
from lyceum_warp.viz.pictures import WorldPictures

AutoresetMode = gymnasium.vector.AutoresetMode


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv[Any, Any, Any]):
    """One task in many worlds, as ``gymnasium.vector.VectorEnv``.

    ``infos`` holds ``eval``, ``done_reason``, and where the task has them ``success``, ``metrics`` and
    ``episode_metrics``, arrays with a value for each world. In the mode SAME_STEP a world whose episode ends shows the
    first observation of the next one; ``infos["final_obs"]`` then holds the last observations, ``infos["final_info"]``
    what else the last step said, and the masks ``_final_obs`` and ``_final_info`` the worlds that this concerns. Under
    NumPy these four are there if an episode ended, and ``final_obs`` is an object array with None for the other worlds,
    as Gymnasium's wrappers expect. With ``torch=True`` they are always there, as tensors of all worlds, because
    whether an episode ended is not known without waiting for the device.

    In the mode DISABLED an ended world goes on with its end set until it is reset by
    ``reset(options={"reset_mask": mask})``; one with a fault restarts at once, but shows its last good observation.
    NEXT_STEP resets it in the next step, whose action it ignores, at the cost of a second reset phase in every step; a
    few wrappers, such as ``NormalizeObservation``, demand it.

    The first reset without a seed draws one, as Gymnasium's environments do, unless ``seed=`` is given here. Worlds
    under one seed differ, and are the same in every run.

    Args:
        task: A task as ``lw.make`` takes it, or an environment.
        num_envs: Number of worlds.
        autoreset_mode: SAME_STEP, DISABLED or NEXT_STEP of ``gymnasium.vector.AutoresetMode``, or its value; by default
            SAME_STEP, or DISABLED for an environment with ``autoreset=False``.
        torch: Whether to take and give tensors on the environment's device. A step then never waits for the device.
        copy: Whether to give copies. Without, most tensors and most arrays of the CPU are live buffers, which change
            with the next step.
        dict_obs: Whether an observation is a dict of the task's groups. By default it is where there are several;
            False gives the group ``policy`` alone.
        render_mode: "rgb_array" for pictures, or None.
        camera: The camera of pictures, as in ``lyceum_warp.viz.video.write_video``.
        render_size: Their width and height in pixels, even numbers.
        max_episode_steps: Steps after which an episode is truncated; by default the task's horizon.
        **words: Options and parameters for ``lw.make``, as ``device="cuda"`` or ``ctrl_cost_weight=1e-2``.

    Raises:
        ValueError: An argument is unknown or does not fit.
        FileNotFoundError: A package that brings the task's model is not installed.
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
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        check_render_mode(render_mode)
        if max_episode_steps is not None:
            words["horizon"] = max_episode_steps
        same_step = self.autoreset_mode is AutoresetMode.SAME_STEP
        self.env = environment_of(task, num_envs, words, autoreset=same_step)
        self.num_envs = self.env.nworld
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": list(RENDER_MODES), "render_fps": frame_rate(self.env),
            "autoreset_mode": self.autoreset_mode,
        }  # fmt: skip
        self._observations = Observations(self.env, dict_obs=dict_obs)
        self.single_observation_space = observation_space(self.env, dict_obs=self._observations.dict_obs)
        self.single_action_space = action_space(self.env)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)
        self._host = None if torch else HostArrays(self.env, copy=copy)
        self._copy = copy
        self._results = StepResults(self.env, self._observations, self._given)
        self._seeds = ResetSeeds(seeded=isinstance(task, Env) or "seed" in words)
        self._ended = self.env.done.clone()
        self._reset_once = False
        self._pictures = WorldPictures(self.env, camera=camera, size=render_size)

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        return self.env.obs.device

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin new, random episodes.

        Args:
            seed: Restarts the worlds' random streams; without one they go on.
            options: ``{"reset_mask": mask}`` concerns the worlds of the mask alone, (num_envs,) bool.

        Returns:
            The observations and infos of all worlds.

        Raises:
            ResetNeeded: There was no reset of all worlds before that of some.
            ValueError: The seed is not a whole number, or an option is unknown or has another shape or type.
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
            actions: (num_envs, nact), a float32 array, or with ``torch=True`` a tensor on the environment's device.

        Returns:
            Observations, rewards, terminations, truncations and infos.

        Raises:
            ResetNeeded: There was no reset yet.
            ValueError: The actions have another shape or type, or lie on another device.
        """
        if not self._reset_once:
            raise gymnasium.error.ResetNeeded("there was no reset before this step: call reset() first")
        env = self.env
        if self._host is None:
            env.action.copy_(_tensor(actions, env.action).detach())
        else:
            self._host.set_action(actions)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            env.action.masked_fill_(self._ended[:, None], 0.0)  # they are ignored, so that they must be no fault
        env.step()
        if self.autoreset_mode is AutoresetMode.NEXT_STEP:
            env.rand_reset(mask=self._ended)
            self._ended.copy_(env.done)
        obs, rewards, terminations, truncations, infos = self._results()
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            self._add_final(infos, terminations | truncations)
        return obs, rewards, terminations, truncations, infos

    def render(self) -> tuple[Any, ...] | None:
        """A picture of each world, (height, width, 3) uint8; None without a ``render_mode``.

        Raises:
            NoVideoError: The machine cannot draw.
        """
        return None if self.render_mode is None else tuple(self._pictures())

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """A method's result or an attribute's value for each world, of this environment or of the one behind it.

        A tensor with a row for each world gives the rows, anything else the same value for each.
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
        """End the process that draws pictures."""
        if hasattr(self, "_pictures"):  # Gymnasium closes an environment that could not be made, too
            self._pictures.close()

    def _given(self, *buffers: torch.Tensor) -> list[Any]:
        """Buffers as the caller gets them."""
        if self._host is not None:
            return list(self._host.of(*buffers))
        return [buffer.clone() for buffer in buffers] if self._copy else list(buffers)

    def _add_final(self, infos: dict[str, Any], ended: Any) -> None:
        """Add the last observations and infos of episodes that ended in this step."""
        final_info = dict(infos)
        if self._host is None:
            final_obs = self._observations.formed(self._given(*self._observations.final))
        elif ended.any():
            final_obs = self._rows_of_ended(ended)
        else:
            return
        infos |= {"final_obs": final_obs, "_final_obs": ended, "final_info": final_info, "_final_info": ended}

    def _rows_of_ended(self, ended: np.ndarray) -> np.ndarray:
        """The last observations of ended episodes as an object array; None for the other worlds."""
        (worlds,) = ended.nonzero()
        index = torch.from_numpy(worlds).to(self.device)
        values = self._given(*(final[index] for final in self._observations.final))
        rows = np.full(self.num_envs, None, dtype=object)
        for world, row in zip(worlds, self._observations.rows(values), strict=True):
            rows[world] = row
        return rows

    def _mask(self, options: dict[str, Any] | None) -> torch.Tensor | None:
        """The mask of a partial reset, on the device; None for all worlds."""
        if unknown := [name for name in options or {} if name != "reset_mask"]:
            raise ValueError(f'reset has no option {unknown[0]!r}: it takes options={{"reset_mask": mask}}')
        mask = (options or {}).get("reset_mask")
        if mask is None:
            return None
        if isinstance(mask, np.ndarray) and mask.dtype == bool:
            mask = torch.from_numpy(mask).to(self.device)
        check_tensor(mask, "the reset_mask", self.env.done)
        if not self._reset_once:
            raise gymnasium.error.ResetNeeded("no reset came before this reset_mask: call reset() without it first")
        return mask


def _autoreset_mode(given: gymnasium.vector.AutoresetMode | str) -> gymnasium.vector.AutoresetMode:
    try:
        return AutoresetMode(given)
    except ValueError:
        known = ", ".join(mode.value for mode in AutoresetMode)
        raise ValueError(f"there is no autoreset_mode {given!r}: use one of {known}") from None


def _tensor(actions: Any, like: torch.Tensor) -> torch.Tensor:
    if not isinstance(actions, torch.Tensor):
        raise ValueError(f"actions must be {described(like)}, not {described(actions)}: torch=True takes tensors")
    check_tensor(actions, "actions", like)
    return actions
