"""Rollouts of a policy: recorded for learning, or summed up for evaluation."""

import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import TypeVar

import torch
import warp as wp

from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.arrays import torch_view
from lyceum_warp.env import Env
from lyceum_warp.graphs.recorder import Recorder
from lyceum_warp.kernels import collect as record

Module = TypeVar("Module", bound=torch.nn.Module)


class Rollout:
    """A record of a fixed number of steps of every world, allocated once.

    Args:
        env: The environment.
        steps: Steps in a record.
    """

    obs: torch.Tensor
    """Observations before each step, (steps, nworld, nobs)."""
    action: torch.Tensor
    """Actions, (steps, nworld, nact)."""
    step: torch.Tensor
    """Steps since the reset before each step, (steps, nworld)."""
    final_obs: torch.Tensor
    """Observations of the states that each step led to, before any reset, (steps, nworld, nobs)."""
    reward: torch.Tensor
    """Rewards, (steps, nworld)."""
    eval: torch.Tensor
    """Evaluation metric after each step, (steps, nworld)."""
    terminated: torch.Tensor
    """Whether the episode truly ended, (steps, nworld) bool."""
    done: torch.Tensor
    """Whether the episode ended for any reason, (steps, nworld) bool."""
    success: torch.Tensor
    """Whether the goal was met after each step, (steps, nworld) bool."""
    episode_return: torch.Tensor
    """Sum of the rewards of the episode so far, (steps, nworld)."""
    episode_length: torch.Tensor
    """Steps of the episode so far, (steps, nworld)."""

    def __init__(self, env: Env, steps: int) -> None:
        self.env = env
        self.steps = steps
        n, nobs, nact = env.nworld, env.obs_space.size, env.action_space.size
        last = {"obs": (nobs,), "final_obs": (nobs,), "action": (nact,)}
        flags = {"terminated", "done", "success"}
        self._record = record.Record()
        with wp.ScopedDevice(env.device):
            for name in Rollout.__annotations__:
                shape = (steps, n, *last.get(name, ()))
                array = wp.zeros(shape, dtype=bool if name in flags else float)
                setattr(self._record, name, array)
                setattr(self, name, torch_view(array))
            self._index = wp.zeros(1, dtype=int)
            self._return = wp.zeros(n, dtype=float)
            self._fault = wp.zeros(n, dtype=int)
        self.running_return = torch_view(self._return)
        self.faults = torch_view(self._fault)
        """Faults of each world within the record, (nworld,) int32."""
        self._recorder = Recorder(env.device, env.options.graphs)
        self._inputs = [wp.from_torch(env.obs), wp.from_torch(env.action), wp.from_torch(env.episode_step)]
        outputs = [
            env.final_obs, env.reward, env.eval, env.terminated, env.done, env.success, env.done_reason,
        ]  # fmt: skip
        self._outputs = [wp.from_torch(output) for output in outputs]

    @torch.no_grad()
    def collect(self, policy: GaussianPolicy, noise: torch.Tensor) -> None:
        """Run the policy for ``steps`` steps from where the worlds are.

        Args:
            policy: The policy.
            noise: Standard normal numbers, (steps, nworld, nact).
        """
        env = self.env
        self._index.zero_()
        self._fault.zero_()
        for t in range(self.steps):
            policy.sample(env.obs, noise[t], out=env.action)
            self._recorder(self._before_step)
            env.step()
            self._recorder(self._after_step)

    def restart(self) -> None:
        """Begin new episodes in all worlds."""
        self.env.rand_reset()
        self.running_return.zero_()

    def stagger(self, generator: torch.Generator, team: Team | None = None) -> None:
        """Set the worlds' step counters to random steps of an episode, so that time limits fall at all times.

        Worlds that began together and never terminate would otherwise all end together, too, most records would
        hold no end at all, and those that do would be all alike. Returns of these first, shortened episodes are
        not counted.
        """
        env, team = self.env, team or Team()
        if env.horizon == 0:
            return
        state = env.get_state()
        everyones = torch.randint(env.horizon, (team.size * env.nworld,), generator=generator, device=state.device)
        first = everyones[team.rank * env.nworld :][: env.nworld]
        state[:, env.state_space.parts["step"]] = first.unsqueeze(-1).double()
        env.set_state(state)
        self.running_return.masked_fill_(first > 0, torch.nan)

    def trouble(self) -> str:
        """In a sentence, what in the record is not finite; waits for the device."""
        for name, values in (("reward", self.reward), ("observation", self.obs), ("observation", self.final_obs)):
            bad = ~values.isfinite()
            if not bad.any():
                continue
            samples = bad.view(*bad.shape[:2], -1).any(-1)
            t, world, *place = bad.nonzero()[0].tolist()
            number, step = values[t, world, *place].item(), int(self.step[t, world])
            spans = self.env.obs_space.parts.items()
            part = [f" in {part!r}" for part, span in spans for i in place if span.start <= i < span.stop]
            return (
                f"The {name} of the task {self.env.task.name!r} is {number}{''.join(part)}, {step} steps after a reset "
                f"of world {self.env.first_world + world}, and not finite in {int(samples.sum())} of "
                f"{samples.numel()} samples"
            )
        return "Rewards and observations are finite: make the step (delta) smaller"

    def _before_step(self) -> None:
        n, width = self.env.nworld, max(self.env.obs_space.size, self.env.action_space.size)
        args = [self._index, *self._inputs, self._record]
        wp.launch(record.record_inputs, (n, width), args, device=self.env.device)

    def _after_step(self) -> None:
        dim = (self.env.nworld, self.env.obs_space.size)
        args = [self._index, *self._outputs, self._return, self._fault, self._record]
        wp.launch(record.record_outputs, dim, args, device=self.env.device)
        wp.launch(record.advance_index, 1, [self._index], device=self.env.device)


@dataclasses.dataclass(frozen=True)
class Episodes:
    """Finished episodes, one number each; all tensors have shape (episodes,) and lie on the CPU."""

    returns: torch.Tensor
    """Sums of rewards."""
    lengths: torch.Tensor
    """Steps."""
    rewards: torch.Tensor
    """Last rewards."""
    evals: torch.Tensor
    """The evaluation metric at the end."""
    success: torch.Tensor
    """Whether the goal was met at the end."""


def finished(rollout: Rollout) -> torch.Tensor:
    """Sums over the episodes that ended within a rollout, (9,) float64, on its device; see ``summary``."""
    ended = rollout.done & ~rollout.episode_return.isnan()
    returns = rollout.episode_return.double()
    infinity = torch.inf

    def total(part: torch.Tensor) -> torch.Tensor:
        return part.double().masked_fill(~ended, 0.0).sum()

    count = ended.sum().double()
    mean = total(returns) / count.clamp_min(1.0)
    lowest, highest = returns.masked_fill(~ended, infinity).min(), returns.masked_fill(~ended, -infinity).max()
    rest = (rollout.episode_length, rollout.reward, rollout.eval, rollout.success)
    return torch.stack([count, mean, total((returns - mean).square()), lowest, highest, *map(total, rest)])


def summary(sums: Sequence[Sequence[float]]) -> dict[str, float]:
    """Statistics of finished episodes from the sums of several rollouts; nan where none ended."""
    count, mean, square = pooled([(row[0], row[1], row[2]) for row in sums])
    total = [sum(row[i] for row in sums) / count if count else math.nan for i in range(5, 9)]
    return {
        "return_mean": mean if count else math.nan,
        "return_std": math.sqrt(square / count) if count else math.nan,
        "return_min": min(row[3] for row in sums) if count else math.nan,
        "return_max": max(row[4] for row in sums) if count else math.nan,
        "length_mean": total[0],
        "terminal_reward": total[1],
        "eval_mean": total[2],
        "success": total[3],
    }


def pooled(parts: Sequence[tuple[float, float, float]]) -> tuple[float, float, float]:
    """Count, mean and summed squared deviation from the mean of several samples together, from those of each."""
    count = sum(n for n, _, _ in parts)
    mean = sum(n * m for n, m, _ in parts) / count if count else 0.0
    return count, mean, sum(s + n * (m - mean) ** 2 for n, m, s in parts)


def moved(module: Module, env: Env) -> Module:
    """A policy or value function where an environment's observations are: itself, or a copy if it is elsewhere."""
    device = env.obs.device
    if all(parameter.device == device for parameter in module.parameters()):
        return module
    return copy.deepcopy(module).to(device)


@torch.no_grad()
def evaluate(env: Env, policy: torch.nn.Module, episodes: int, *, seed: int | None = None) -> Episodes:
    """Run a policy's mean action for whole episodes from random initial states.

    Every world contributes the same number of episodes, its first ones, so that short episodes do not crowd
    out long ones.

    Args:
        env: The environment; its worlds are reset.
        policy: Called with observations (nworld, nobs), returns actions (nworld, nact).
        episodes: How many; rounded up to a multiple of the number of worlds.
        seed: Seed of the initial states; by default the worlds go on with their random streams.

    Raises:
        ValueError: The task never ends an episode.
    """
    if env.horizon == 0:
        raise ValueError(f"episodes of {env.task.name!r} never end without a horizon: give make() a horizon")
    if not env.autoreset:
        raise ValueError("whole episodes need an environment that resets by itself: make it with autoreset=True")
    each = -(-episodes // env.nworld)
    env.rand_reset(seed)
    results = torch.zeros(5, each, env.nworld, device=env.obs.device)
    count = torch.zeros(env.nworld, dtype=torch.long, device=env.obs.device)
    total = torch.zeros(env.nworld, device=env.obs.device)
    worlds = torch.arange(env.nworld, device=env.obs.device)
    for t in range(each * env.horizon):
        length = env.episode_step + 1.0
        env.action.copy_(policy(env.obs))
        env.step()
        total += env.reward
        now = torch.stack([total, length, env.reward, env.eval, env.success.float()])
        slot = count.clamp_max(each - 1)
        wanted = env.done & (count < each)
        results[:, slot, worlds] = torch.where(wanted, now, results[:, slot, worlds])
        total.masked_fill_(env.done, 0.0)
        count += wanted
        if t % 50 == 49 and bool((count >= each).all()):
            break
    return Episodes(*results.reshape(5, -1).cpu())
