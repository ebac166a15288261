"""Compute statistics over the episodes that ended in a rollout."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import torch

from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.learner import NESTED, Iteration
from lyceum_warp.algos.rollout_buffer import Rollout
from lyceum_warp.support.docstrings import document_attributes

Scalar: TypeAlias = Any
"""A scalar tensor, or a float on the host."""


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class SampledIteration(Iteration):
    """Statistics of one iteration of NPG, PPO or SAC.

    Episode statistics cover the episodes that ended in the iteration; they are NaN if no episode ended.
    """

    faults: int
    """Number of faults in the iteration, over all worlds."""
    time_sample: float
    """Seconds for sampling."""
    time_mean: float
    """Seconds for evaluating the mean policy."""
    samples_per_second: float
    """Samples per second of sampling; with SAC, per second of sampling and updates."""

    def row(self) -> dict[str, Any]:
        """Convert the statistics to a row of metrics.csv, including values that are None."""
        names = [field.name for field in dataclasses.fields(self) if field.name not in NESTED]
        return {name: getattr(self, name) for name in names} | super().row()


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class OnPolicyIteration(SampledIteration):
    """Statistics of one iteration of NPG or PPO."""

    kl: float
    """KL divergence from the old to the new policy, averaged over the samples."""
    std_mean: float
    """Mean standard deviation of the policy's actions."""


class EpisodeSums(NamedTuple):
    """Statistics of the episodes that ended in one process's worlds.

    ``return_square`` is the sum of the squared deviations of the returns from their mean. ``length`` and the following
    fields are sums over the episodes.
    """

    episodes: Scalar
    return_mean: Scalar
    return_square: Scalar
    return_min: Scalar
    return_max: Scalar
    length: Scalar
    terminal_reward: Scalar
    eval: Scalar
    success: Scalar


class Moments(NamedTuple):
    """Number, mean and sum of squared deviations from the mean of a set of numbers."""

    n: float
    mean: float
    square: float


def gathered(
    rollout: Rollout, team: Team, numbers: Mapping[str, torch.Tensor]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Gather the statistics of all processes in one copy to the host.

    Args:
        rollout: This process's samples.
        team: The processes.
        numbers: Further numbers of this process, scalar tensors by name.

    Returns:
        The fields of ``SampledIteration`` that describe samples and episodes, by name; and ``numbers`` of each process.
    """
    samples = [rollout.reward.double().mean(), rollout.faults.sum()]
    scalars = [*samples, *finished(rollout), *metric_sums(rollout), *numbers.values()]
    processes = team.gather(torch.stack([scalar.double() for scalar in scalars])[None]).tolist()
    split = len(samples) + len(EpisodeSums._fields)
    end = split + 2 * len(rollout.metrics)
    rewards, faults = ([process[i] for process in processes] for i in range(len(samples)))
    episodes = [EpisodeSums(*process[len(samples) : split]) for process in processes]
    sums, count = [process[split:end] for process in processes], sum(part.episodes for part in episodes)
    statistics = {
        "reward_mean": sum(rewards) / len(processes), "faults": round(sum(faults)), **episode_statistics(episodes),
        **metric_means(count, sums, list(rollout.metrics)),
    }  # fmt: skip
    return statistics, [dict(zip(numbers, process[end:], strict=True)) for process in processes]


def finished(rollout: Rollout) -> EpisodeSums:
    """Compute sums over the episodes that ended in a rollout."""
    ended = _ended(rollout)
    returns = rollout.episode_return.double()
    infinity = torch.inf

    def total(part: torch.Tensor) -> torch.Tensor:
        return part.double().masked_fill(~ended, 0.0).sum()

    episodes = ended.sum().double()
    mean = total(returns) / episodes.clamp_min(1.0)
    return EpisodeSums(
        episodes=episodes,
        return_mean=mean,
        return_square=total((returns - mean).square()),
        return_min=returns.masked_fill(~ended, infinity).min(),
        return_max=returns.masked_fill(~ended, -infinity).max(),
        length=total(rollout.episode_length),
        terminal_reward=total(rollout.reward),
        eval=total(rollout.eval),
        success=total(rollout.success),
    )


def metric_sums(rollout: Rollout) -> tuple[torch.Tensor, ...]:
    """Sum the task's metrics over the ended episodes of a rollout, and average them over all samples.

    Non-finite metrics count as zero.
    """
    ended = _ended(rollout)
    sums = [sums.double().masked_fill(~ended, 0.0).sum() for sums in rollout.episode_metrics.values()]
    return (*sums, *(steps.double().nan_to_num(0.0, 0.0, 0.0).mean() for steps in rollout.metrics.values()))


def _ended(rollout: Rollout) -> torch.Tensor:
    return rollout.done & ~rollout.episode_return.isnan()


def metric_means(episodes: float, sums: Sequence[Sequence[float]], names: Sequence[str]) -> dict[str, Any]:
    """Compute ``Iteration.metrics`` and ``Iteration.step_metrics``."""
    totals = [sum(parts) for parts in zip(*sums, strict=True)]
    ended, steps = totals[: len(names)], totals[len(names) :]
    return {
        "metrics": {name: total / episodes if episodes else math.nan for name, total in zip(names, ended, strict=True)},
        "step_metrics": {name: total / len(sums) for name, total in zip(names, steps, strict=True)},
    }


def episode_statistics(sums: Sequence[EpisodeSums]) -> dict[str, float]:
    """Compute statistics of the finished episodes of all processes; NaN if no episode ended."""
    episodes, mean, square = pooled([Moments(part.episodes, part.return_mean, part.return_square) for part in sums])
    if not episodes:
        return dict.fromkeys(_EPISODE_STATISTICS, math.nan)
    numbers = (
        mean,
        math.sqrt(square / episodes),
        min(part.return_min for part in sums),
        max(part.return_max for part in sums),
        sum(part.length for part in sums) / episodes,
        sum(part.terminal_reward for part in sums) / episodes,
        sum(part.eval for part in sums) / episodes,
        sum(part.success for part in sums) / episodes,
    )
    return dict(zip(_EPISODE_STATISTICS, numbers, strict=True))


_EPISODE_STATISTICS = (
    "return_mean", "return_std", "return_min", "return_max", "length_mean", "terminal_reward", "eval_mean", "success",
)  # fmt: skip


def pooled(parts: Sequence[Moments]) -> Moments:
    """Compute the moments of the union of several sets."""
    n = sum(part.n for part in parts)
    mean = sum(part.n * part.mean for part in parts) / n if n else 0.0
    return Moments(n, mean, sum(part.square + part.n * (part.mean - mean) ** 2 for part in parts))
