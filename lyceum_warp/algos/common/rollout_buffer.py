"""Store the samples of a fixed number of steps in a preallocated buffer."""

from collections.abc import Callable, Collection
from typing import Any, TypeAlias

import numpy as np
import torch
import warp as wp

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.algos.common.policy import GaussianPolicy
from lyceum_warp.core.spaces import Space
from lyceum_warp.engines.memory import check_fit
from lyceum_warp.env.env import Env
from lyceum_warp.graphs.capture import Graphs, Phase
from lyceum_warp.kernels import collect
from lyceum_warp.support.arrays import torch_view, words
from lyceum_warp.support.validate import check_flag, check_group, check_kind, whole_number

_Pair: TypeAlias = tuple[Any, wp.array]
"""An array of an environment, and the buffer that stores it for each step."""


class Rollout:
    """Preallocated buffer that holds the samples from a fixed number of steps in every world.

    Args:
        env: The environment.
        steps: Number of steps.
        groups: Groups of observations to store in addition to "policy", such as ``("critic",)``.
        first_only: Whether the statistics include only each world's first episode since ``restart``. If all worlds
            start together, statistics of all finished episodes are biased towards short episodes.

    Raises:
        ValueError: The task has no group of observations of this name.
    """

    obs: torch.Tensor
    """Observations before each step, (steps, nworld, nobs)."""
    action: torch.Tensor
    """Actions, (steps, nworld, nact)."""
    step: torch.Tensor
    """Number of steps between the reset and each step, (steps, nworld)."""
    final_obs: torch.Tensor
    """Observations after each step, before any reset, (steps, nworld, nobs)."""
    obs_groups: dict[str, torch.Tensor]
    """Observations of each group before each step; the entry "policy" is ``obs``. Pictures have the shape (steps,
    nworld, height, width, channels)."""
    final_obs_groups: dict[str, torch.Tensor]
    """Observations of each group after each step, without pictures; the entry "policy" is ``final_obs``."""
    reward: torch.Tensor
    """Rewards, (steps, nworld)."""
    eval: torch.Tensor
    """Evaluation metric after each step, (steps, nworld)."""
    terminated: torch.Tensor
    """Whether the task ended the episode, (steps, nworld) bool. A fault is a truncation, not a termination."""
    done: torch.Tensor
    """Whether the episode ended for any reason, (steps, nworld) bool."""
    success: torch.Tensor
    """Whether the goal is met after each step, (steps, nworld) bool."""
    episode_return: torch.Tensor
    """Sum of the episode's rewards so far, (steps, nworld); NaN in episodes that the statistics exclude."""
    episode_length: torch.Tensor
    """Number of the episode's steps so far, (steps, nworld)."""
    episode_metrics: dict[str, torch.Tensor]
    """Each metric of the task, summed over the episode so far, (steps, nworld)."""
    metrics: dict[str, torch.Tensor]
    """Each metric of the task at each step, (steps, nworld)."""

    index: torch.Tensor
    """The next step to store, (1,) int32."""
    running_return: torch.Tensor
    """Sum of the rewards of each world's current episode, (nworld,); NaN in episodes that the statistics exclude."""
    faults: torch.Tensor
    """Number of faults of each world in these steps, (nworld,) int32."""

    def __init__(self, env: Env, steps: int, *, groups: Collection[str] = (), first_only: bool = False) -> None:
        check_kind("env of Rollout", env, Env, "as lw.make(...) makes it")
        check_kind("groups", groups, list | tuple | set | frozenset, "as in groups=['critic']")
        check_flag("first_only", first_only)
        steps = whole_number("steps", steps, low=1)
        for group in groups:
            check_group(group, env.obs_groups, env.task.name)
        self.env = env
        self.steps = steps
        self._first_only = first_only
        n, nobs, nact = env.nworld, env.obs_space.size, env.action_space.size
        numbers = len(collect.RolloutArrays.vars) + 2 * nobs + nact  # type: ignore[attr-defined]
        # a learner shuffles a copy of the pictures
        numbers += 2 * sum(words(env.obs_groups[g]).shape[1] for g in groups if g not in env.worlds.obs_spaces)
        check_fit(4 * steps * numbers, n, env.device, model=f"{steps} steps")
        flags = {"terminated", "done", "success"}
        self._arrays = collect.RolloutArrays()
        with wp.ScopedDevice(env.device):
            for name in collect.RolloutArrays.vars:  # type: ignore[attr-defined]
                array = wp.zeros((steps, n), dtype=bool if name in flags else float)
                setattr(self._arrays, name, array)
                setattr(self, name, torch_view(array))
            self._index = wp.zeros(1, dtype=int)
            self._return = wp.zeros(n, dtype=float)
            self._fault = wp.zeros(n, dtype=int)
        self.index = torch_view(self._index)
        self.running_return, self.faults = torch_view(self._return), torch_view(self._fault)
        self._rows_before: list[_Pair] = []
        self._rows_after: list[_Pair] = []
        self.action = self._stored(env.action, self._rows_before)
        self.obs_groups, self.final_obs_groups = {}, {}
        for group in dict.fromkeys(("policy", *groups)):
            if group in env.worlds.obs_spaces:
                self.obs_groups[group] = self._stored(env.obs_groups[group], self._rows_before)
                self.final_obs_groups[group] = self._stored(env.final_obs_groups[group], self._rows_after)
            else:
                picture = env.obs_groups[group]
                rows = self._stored(words(picture), self._rows_before)
                self.obs_groups[group] = rows.view(picture.dtype).view(steps, *picture.shape)
        self.obs, self.final_obs = self.obs_groups["policy"], self.final_obs_groups["policy"]
        self.metrics, self.episode_metrics = {}, {}
        if env.metrics:
            steps_of = self._stored(torch_view(env.worlds.metrics), self._rows_after)
            sums_of = self._stored(env.episode_metric_sums, self._rows_after)
            self.metrics = dict(zip(env.metrics, steps_of.unbind(-1), strict=True))
            self.episode_metrics = dict(zip(env.metrics, sums_of.unbind(-1), strict=True))
        several = len(env.task.objects) > 1 and env.task.functions["success"] is not None
        self._object = self._stored(env.field("object"), self._rows_before) if several else None
        outputs = (env.reward, env.eval, env.terminated, env.done, env.success, env.done_reason)
        self._steps, self._outputs = wp.from_torch(env.episode_step), [wp.from_torch(t) for t in outputs]
        graphs = Graphs(env.device, enabled=env.options.graphs)
        self._before_step = graphs.sequence([Phase("store inputs", self._launch_inputs)])
        self._after_step = graphs.sequence([Phase("store outputs", self._launch_outputs)])

    @property
    def objects(self) -> dict[str, torch.Tensor]:
        """Whether each world holds an object, by the object's name, (steps, nworld) bool.

        Empty unless the worlds hold several objects, and the task defines ``success``.
        """
        held = self._object
        return {} if held is None else {name: held[..., 0] == index for name, index in self.env.task.objects.items()}

    def store_too(self, source: torch.Tensor) -> torch.Tensor:
        """Let ``store_inputs`` also store a tensor, (nworld, size), and return the buffer, (steps, nworld, size)."""
        return self._stored(source, self._rows_before)

    def _stored(self, source: torch.Tensor, into: list[_Pair]) -> torch.Tensor:
        rows: wp.array = wp.zeros((self.steps, *source.shape), dtype=float, device=self.env.device)
        into.append((wp.from_torch(source), rows))
        return torch_view(rows)

    @torch.no_grad()
    def collect(self, policy: GaussianPolicy, noise: torch.Tensor) -> None:
        """Fill the buffer by running the policy for ``steps`` steps from the current states.

        Args:
            policy: The policy.
            noise: Standard normal numbers, (steps, nworld, nact).
        """
        rows = iter(noise)
        self.fill(lambda: policy.sample(self.env.obs, next(rows), out=self.env.action))

    def fill(self, act: Callable[[], object], observe: Callable[[], object] = lambda: None) -> None:
        """Fill the buffer in ``steps`` steps. ``act`` writes their actions, and ``observe`` runs after each step."""
        self.begin()
        for _ in range(self.steps):
            act()
            self.store_inputs()
            self.env.step()
            self.store_outputs()
            observe()

    def begin(self) -> None:
        """Prepare the buffer for a caller that steps the environment itself, without ``fill``."""
        self._index.zero_()
        self._fault.zero_()

    def store_inputs(self) -> None:
        """Store the observations, the actions and the step counters before a step."""
        for call in self._before_step:
            call()

    def store_outputs(self) -> None:
        """Store the results of a step."""
        for call in self._after_step:
            call()

    def restart(self) -> None:
        """Start new episodes in all worlds."""
        self.env.rand_reset()
        self.running_return.zero_()

    def stagger(self, generator: torch.Generator, team: Team | None = None) -> None:
        """Set the worlds' step counters to random values, so that time limits are spread over time.

        Otherwise, worlds that start together and never terminate reach their time limits in the same rollout. The
        statistics exclude the shortened episodes. On the Warp engine, this method does nothing if the task sets
        ``lw.Task.settle``. On this engine, all worlds wait while one world settles after a reset.

        Args:
            generator: Random generator with the same state in every process.
            team: The processes.
        """
        env, team = self.env, team or Team()
        if env.horizon == 0 or (env.task.definition.settle and env.engine.capturable):
            return
        state = env.get_state()
        steps = torch.randint(env.horizon, (team.size * env.nworld,), generator=generator, device=state.device)
        first = steps[team.rank * env.nworld :][: env.nworld]
        state[:, env.state_space.parts["step"]] = first.unsqueeze(-1).double()
        env.set_state(state)
        self.running_return.masked_fill_(first > 0, torch.nan)

    def restart_some(self, least: int, generator: torch.Generator, team: Team | None = None) -> None:
        """Restart random worlds so that at least ``least`` worlds started an episode within the last ``steps`` steps.

        The statistics exclude interrupted episodes. Do not call this method if ``first_only`` is set, because the
        statistics would then include the second episode of a restarted world. The host does not wait for the device.

        Args:
            least: Minimum number of such worlds, over all processes.
            generator: Random generator with the same state in every process.
            team: The processes.
        """
        env, team = self.env, team or Team()
        began = team.gather((env.episode_step < self.steps).int())
        order = torch.rand(len(began), generator=generator, device=began.device) + 2.0 * began
        rank = order.argsort(stable=True).argsort()
        restarts = (rank < least - began.sum()) & (began == 0)
        mask = restarts[team.rank * env.nworld :][: env.nworld]
        env.rand_reset(mask=mask)
        self.running_return.masked_fill_(mask, 0.0)

    def extremes(self) -> str:
        """Describe the reward and the observation of each group that have the largest magnitude, for error messages."""
        rows = {"reward": (self.reward.unsqueeze(-1), Space())}
        for group in self.final_obs_groups:
            obs = self.obs_groups[group]
            name = "observation" if group == "policy" else f"observation of the group {group!r}"
            rows[name] = obs, self.env.obs_spaces[group]
        texts = []
        for name, (values, space) in rows.items():
            t, world, column = map(int, np.unravel_index(int(values.abs().argmax()), values.shape))
            part = f" in {space.part_at(column)!r}" if space.parts else ""
            where = f"in step {t + 1} of world {self.env.first_world + world}"
            texts.append(f"the largest {name} is {values[t, world, column]:g}{part} {where}")
        return "; ".join(texts)

    def _launch_inputs(self) -> None:
        args = [self._index, self._steps, self._arrays.step]
        wp.launch(collect.store_steps, self.env.nworld, args, device=self.env.device)
        self._launch_rows(self._rows_before)

    def _launch_outputs(self) -> None:
        args = [self._index, *self._outputs, self._first_only, self._return, self._fault, self._arrays]
        wp.launch(collect.store_outputs, self.env.nworld, args, device=self.env.device)
        self._launch_rows(self._rows_after)
        wp.launch(collect.advance_index, 1, [self._index], device=self.env.device)

    def _launch_rows(self, pairs: list[_Pair]) -> None:
        for source, rows in pairs:
            wp.launch(collect.store_rows, source.shape, [self._index, source, rows], device=self.env.device)
