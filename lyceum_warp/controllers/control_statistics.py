"""Statistics of a controller's episodes: planning times, samples, the plant's schedule, success."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from lyceum_warp.controllers.trajectory import Trajectory

# the least number of plans for each quantile: of fewer, none is expected beyond it
_QUANTILES = {"p50": (0.5, 2), "p90": (0.9, 10), "p99": (0.99, 100), "p99_9": (0.999, 1000)}


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % confidence interval of a share (Wilson 1927): within 0 and 1, with a width even at 0 and 1."""
    z = 1.959963984540054
    share = successes / trials
    middle = share + z * z / (2 * trials)
    spread = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    low, high = ((middle + sign * spread) / (1 + z * z / trials) for sign in (-1, 1))
    return max(0.0, low), min(1.0, high)


def joined(parts: Iterable[torch.Tensor]) -> np.ndarray:
    """Tensors of all episodes as one array."""
    return torch.cat(list(parts)).numpy()


def std(values: np.ndarray) -> float | None:
    """Standard deviation of a sample (n - 1); None for fewer than two values, and for values that are not finite."""
    return float(values.std(ddof=1)) if len(values) > 1 and np.isfinite(values).all() else None


def differing_names(mappings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names whose values differ between the mappings."""
    names = dict.fromkeys(name for mapping in mappings for name in mapping)
    # compared as text, in which NaN equals NaN
    return [name for name in names if len({json.dumps(mapping.get(name)) for mapping in mappings}) > 1]


def plan_statistics(episodes: Sequence[Trajectory], deadline: float) -> dict[str, Any]:
    """Planning times in milliseconds, their rate and the missed deadlines, without the first plan of each episode."""
    times = joined(episode.plan_times[1:] for episode in episodes)
    misses = int((times > deadline).sum())
    return {
        "plans": len(times),
        "first_plan_ms": 1000 * max(float(episode.plan_times[0]) for episode in episodes),
        "plan_mean_ms": 1000 * float(times.mean()) if len(times) else None,
        **{
            f"plan_{name}_ms": float(np.quantile(1000 * times, q)) if len(times) >= enough else None
            for name, (q, enough) in _QUANTILES.items()
        },
        "plan_max_ms": 1000 * float(times.max()) if len(times) else None,
        "plan_jitter_ms": std(1000 * times),
        "plans_per_second": _plans_per_second(episodes),
        "deadline_ms": 1000 * deadline,
        "misses": misses,
        "miss_share": misses / len(times) if len(times) else None,
    }


def _plans_per_second(episodes: Sequence[Trajectory]) -> float | None:
    """Rate of the plans without the first ones, and without the time on the clock that those took."""
    plans, seconds = 0, 0.0
    for episode in episodes:
        ends = episode.plan_starts + episode.plan_times
        plans += int((ends[1:] <= episode.wall_seconds).sum())  # the last one may have ended after the plant stopped
        seconds += episode.wall_seconds - max(0.0, float(ends[0]))
    return plans / seconds if plans and seconds > 0 else None


def sample_statistics(episodes: Sequence[Trajectory]) -> dict[str, Any]:
    """Failed and effective samples, of the plans for which the controller reported them."""
    failed, effective = (joined(getattr(e, name) for e in episodes) for name in ("plan_failed", "plan_effective"))
    failed, effective = failed[np.isfinite(failed)], effective[np.isfinite(effective)]
    samples = episodes[0].controller.get("samples")
    known = isinstance(samples, int) and samples > 0 and len(failed) > 0
    return {
        "blind_plans": int((failed >= samples).sum()) if known else None,
        "known_plans": len(failed) if known else 0,
        "failed_share": float(failed.mean() / samples) if known else None,
        "effective_samples_mean": float(effective.mean()) if len(effective) else None,
    }


def tick_statistics(episodes: Sequence[Trajectory]) -> dict[str, Any]:
    """Delays of the steps of a plant that keeps its rate, in milliseconds; None if the plant waits for its plans."""
    if episodes[0].mode == "sync":
        return {"tick_jitter_ms": None, "tick_delay_max_ms": None, "late_ticks": None}
    delays = 1000 * joined(episode.times - episode.period * torch.arange(episode.steps) for episode in episodes)
    return {
        "tick_jitter_ms": std(delays),
        "tick_delay_max_ms": float(delays.max()),
        "late_ticks": sum(int(episode.late.sum()) for episode in episodes),
    }


def age_statistics(episodes: Sequence[Trajectory]) -> dict[str, Any]:
    """Ages of the applied actions, in milliseconds and in steps."""
    ages = joined(episode.ages for episode in episodes)
    age_steps = joined(episode.age_steps for episode in episodes)
    return {
        "age_mean_ms": 1000 * float(ages.mean()),
        "age_max_ms": 1000 * float(ages.max()),
        "age_steps_mean": float(age_steps.mean()),
        "age_steps_max": int(age_steps.max()),
    }


def outcome_statistics(episodes: Sequence[Trajectory]) -> dict[str, Any]:
    """Durations, returns, evaluations and success of the episodes."""
    returns = np.array([episode.episode_return for episode in episodes])
    wall, steps = sum(episode.wall_seconds for episode in episodes), sum(episode.steps for episode in episodes)
    successes = sum(episode.succeeded for episode in episodes)
    low, high = wilson(successes, len(episodes))
    return {
        "episodes": len(episodes),
        "steps": steps,
        "real_time_factor": steps * episodes[0].timestep / wall,
        "episode_seconds_mean": wall / len(episodes),
        "return_mean": float(returns.mean()),
        "return_std": std(returns),
        "eval_mean": float(np.mean([float(episode.evals[-1]) for episode in episodes])),
        "success": successes / len(episodes),
        "success_low": low,
        "success_high": high,
    }
