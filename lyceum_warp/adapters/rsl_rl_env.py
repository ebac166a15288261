"""Adapt an environment to rsl_rl's VecEnv."""

from typing import Any

import torch

from lyceum_warp.adapters.adapted_env import environment_of
from lyceum_warp.core import FAULTS, Task
from lyceum_warp.env import Env

try:
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict
except ImportError as error:
    raise ImportError("this adapter needs the package rsl-rl-lib: pip install 'lyceum-warp[rsl-rl]'") from error

RECENT = 100
"""Logged metrics are averages over about this number of recent episodes."""


class RslRlVecEnv(VecEnv):  # type: ignore[misc]
    """An environment for rsl_rl's runners: ``OnPolicyRunner(RslRlVecEnv("hopper", 4096, device="cuda"), config)``.

    ``step`` never waits for the device. ``step`` copies the observations, because rsl_rl stores them only after the
    next step. All other results are buffers that the next step overwrites. rsl_rl copies them before that.

    Args:
        task: A task, as in ``lw.make``, or an environment with automatic resets.
        num_envs: Number of worlds; by default one, or the number in the given environment.
        options: Options and parameters, as for ``lw.make``.

    Raises:
        ImportError: rsl_rl was not installed when this module was imported.
    """

    num_envs: int
    num_actions: int
    max_episode_length: int
    """Steps after which an episode is truncated, or 2147483647 without a horizon."""
    device: torch.device
    cfg: dict[str, Any]
    """The task, its parameters, the engine and the number of worlds, for rsl_rl's logs."""

    def __init__(self, task: str | type[Task] | Env, num_envs: int | None = None, **options: Any) -> None:
        self.env = env = environment_of(task, num_envs, options, autoreset=True)
        self.num_envs, self.num_actions = env.nworld, env.action_space.size
        self.max_episode_length = env.horizon or 2**31 - 1
        self.device = env.obs.device
        self.cfg = {
            "task": env.task.name, "params": env.given_params, "engine": env.engine.name, "nworld": env.nworld,
            "physics": env.options.physics.given(), "horizon": env.horizon,
        }  # fmt: skip
        self._obs = TensorDict(env.obs_groups, batch_size=[env.nworld], device=self.device)
        self._final_obs = TensorDict(env.final_obs_groups, batch_size=[env.nworld], device=self.device)
        self._metrics = torch.zeros(len(env.metrics), device=self.device)
        self._episodes = torch.zeros((), device=self.device)

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """Steps since the reset, (nworld,) int32, a live view.

        Assign a tensor to change how many steps remain until each episode is truncated.
        """
        return self.env.episode_step

    @episode_length_buf.setter
    def episode_length_buf(self, steps: torch.Tensor) -> None:
        env = self.env
        if env.horizon == 0:
            raise ValueError(
                f"episodes of {env.task.name!r} have no time limit, so they cannot begin at a random step: call "
                "learn with init_at_random_ep_len=False, or give make() a horizon"
            )
        if ((steps < 0) | (steps >= env.horizon)).any():
            raise ValueError(
                f"episode_length_buf must be from 0 to {env.horizon - 1}, not from {steps.min()} to {steps.max()}"
            )
        state = env.get_state()
        state[:, env.state_space.parts["step"]] = steps.to(state).unsqueeze(-1)
        env.set_state(state)

    def get_observations(self) -> TensorDict:
        """Return a copy of the current observations by group, each (nworld, group size)."""
        return self._obs.clone()

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Advance every world by one step, and restart worlds whose episode ended.

        Args:
            actions: (nworld, nact), float32.

        Returns:
            Observations, rewards (nworld,), dones (nworld,) bool, and a dict with these entries:

            - ``time_outs``: whether the time limit or a fault truncated the episode, (nworld,) bool. After a fault, the
              reward is 0, and the last valid observation is the final observation.
            - ``final_obs``: the observations after the step and before any reset, by group.
            - ``log``: ``metrics/NAME`` are averages of the task's metrics over about the last 100 ended episodes. They
              include episodes that end in this step. ``faults/worlds`` is the number of worlds with a fault. Averages
              are 0 until an episode has ended.

        Raises:
            ValueError: The actions have the wrong shape, type or device.
        """
        env = self.env
        env.step(actions)
        extras = {
            "time_outs": env.truncated & ~env.terminated,
            "final_obs": self._final_obs,
            "log": self._log() | {"faults/worlds": ((env.done_reason & FAULTS) != 0).sum()},
        }
        return self._obs.clone(), env.reward, env.done, extras

    def _log(self) -> dict[str, torch.Tensor]:
        # rsl_rl averages the logs of an iteration's steps with equal weights, even if only one episode ended in a step.
        # Each log therefore contains means over recent episodes, not only over episodes that ended in this step.
        env = self.env
        if not env.metrics:
            return {}
        ended, sums = env.done.sum(), env.episode_metric_sums.masked_fill(~env.done.unsqueeze(-1), 0.0).sum(0)
        earlier = torch.minimum(self._episodes, (RECENT - ended).clamp_min(0))
        self._episodes = earlier + ended
        self._metrics = (earlier * self._metrics + sums) / self._episodes.clamp_min(1.0)
        return {f"metrics/{name}": mean for name, mean in zip(env.metrics, self._metrics.unbind(), strict=True)}
