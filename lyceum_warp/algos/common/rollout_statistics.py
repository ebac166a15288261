"""Compute an iteration's statistics from its samples and finished episodes."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.algos.common.learner import METRIC_COLUMN, NESTED, STEP_METRIC_COLUMN, Iteration
from lyceum_warp.algos.common.rollout_buffer import Rollout


@dataclasses.dataclass(frozen=True, kw_only=True)
class SampledIteration(Iteration):
    """Statistics of one iteration of NPG, PPO, SAC or Distill.

    Episode statistics cover the episodes that ended in the iteration; they are NaN if no episode ended.
    """

    faults: int
    """Number of faults in the iteration, over all worlds."""
    time_sample: float
    """Seconds for sampling."""
    time_mean: float
    """Seconds for evaluating the mean policy."""
    samples_per_second: float
    """Samples per second during sampling. With SAC and Distill, the time of the updates counts too."""

    def row(self) -> dict[str, Any]:
        """Convert the statistics to a row of metrics.csv, including values that are None."""
        names = [field.name for field in dataclasses.fields(self) if field.name not in NESTED]
        return {name: getattr(self, name) for name in names} | super().row()


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnPolicyIteration(SampledIteration):
    """Statistics of one iteration of NPG or PPO."""

    kl: float
    """KL divergence from the old to the new policy, averaged over the samples."""
    std_mean: float
    """Mean standard deviation of the policy's actions."""


def gathered(
    rollout: Rollout, team: Team, numbers: Mapping[str, torch.Tensor]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Gather the statistics of all processes in one copy to the host.

    Args:
        rollout: This process's samples.
        team: The processes.
        numbers: Additional scalar tensors of this process, by name.

    Returns:
        The fields of ``SampledIteration`` that describe samples and episodes, and the ``numbers`` of each process.
    """
    named = {**_sums(rollout), **numbers}
    rows = team.gather(torch.stack([scalar.double() for scalar in named.values()])[None]).tolist()
    processes = [dict(zip(named, row, strict=True)) for row in rows]
    episodes, mean, square = pooled(processes, "episodes", "return_mean", "return_square")

    def total(name: str) -> float:
        return sum(process[name] for process in processes)

    def by_episode(name: str) -> float:
        return total(name) / episodes if episodes else math.nan

    statistics = {
        "reward_mean": total("reward") / len(processes),
        "faults": round(total("faults")),
        "return_mean": mean if episodes else math.nan,
        "return_std": math.sqrt(square / episodes) if episodes else math.nan,
        "return_min": min(process["return_min"] for process in processes) if episodes else math.nan,
        "return_max": max(process["return_max"] for process in processes) if episodes else math.nan,
        **{name: by_episode(name) for name in ("length_mean", "terminal_reward", "eval_mean", "success")},
        "metrics": {name: by_episode(METRIC_COLUMN + name) for name in rollout.metrics}
        | {
            f"success/{name}": total(f"success/{name}") / count if (count := total(f"episodes/{name}")) else math.nan
            for name in rollout.objects
        },
        "step_metrics": {name: total(STEP_METRIC_COLUMN + name) / len(processes) for name in rollout.metrics},
    }
    return statistics, [{name: process[name] for name in numbers} for process in processes]


def _sums(rollout: Rollout) -> dict[str, torch.Tensor]:
    """Compute sums over the episodes that ended in a rollout, and means over all samples."""
    ended = rollout.done & ~rollout.episode_return.isnan()
    returns = rollout.episode_return.double()

    def total(part: torch.Tensor) -> torch.Tensor:
        return part.double().masked_fill(~ended, 0.0).sum()

    episodes = ended.sum().double()
    mean = total(returns) / episodes.clamp_min(1.0)
    return {
        "reward": rollout.reward.double().mean(),
        "faults": rollout.faults.sum(),
        "episodes": episodes,
        "return_mean": mean,
        "return_square": total((returns - mean).square()),
        "return_min": returns.masked_fill(~ended, torch.inf).min(),
        "return_max": returns.masked_fill(~ended, -torch.inf).max(),
        "length_mean": total(rollout.episode_length),
        "terminal_reward": total(rollout.reward),
        "eval_mean": total(rollout.eval),
        "success": total(rollout.success),
        **{f"success/{name}": total(rollout.success & held) for name, held in rollout.objects.items()},
        **{f"episodes/{name}": total(held) for name, held in rollout.objects.items()},
        **{METRIC_COLUMN + name: total(sums) for name, sums in rollout.episode_metrics.items()},
        **{STEP_METRIC_COLUMN + name: steps.double().nan_to_num(0.0, 0.0, 0.0).mean()
           for name, steps in rollout.metrics.items()},
    }  # fmt: skip


def pooled(parts: Sequence[Mapping[str, float]], *names: str) -> tuple[float, float, float]:
    """Compute the size, mean and sum of squared deviations of the union of several sets.

    Args:
        parts: One mapping for each set, with the set's size, mean and sum of squared deviations.
        names: The keys of these three values in each mapping.
    """
    sets = [[part[name] for name in names] for part in parts]
    n = sum(size for size, _, _ in sets)
    mean = sum(size * mean for size, mean, _ in sets) / n if n else 0.0
    return n, mean, sum(square + size * (set_mean - mean) ** 2 for size, set_mean, square in sets)
