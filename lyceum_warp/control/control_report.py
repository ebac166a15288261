"""Reports of controlled worlds: what came of it, and how well the controller kept up with its plant."""

import dataclasses
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lyceum_warp.control.trajectory import Trajectory

# of how many plans a quantile can be told: of fewer, none would lie beyond it
_QUANTILES = {"p50": (0.5, 2), "p90": (0.9, 10), "p99": (0.99, 100), "p99_9": (0.999, 1000)}


@dataclasses.dataclass(frozen=True)
class ControlReport:
    """How a controller did, and how well it kept up with its plant; see ``control_report``.

    None stands for what there is too little of, what there is not, or what the controller does not tell. The first
    plan of each trajectory is told of apart, and is in no other number about the plans' time: it alone loads kernels
    and makes recordings.
    """

    task: str
    """Name of the task."""
    engine: str
    """Name of the engine of the plant."""
    mode: str
    """"sync" if the plant waited for its plans, "async" if it kept its rate."""
    episodes: int
    """Trajectories."""
    steps: int
    """Steps of them all."""
    plans: int
    """Plans without the first ones."""
    first_plan_ms: float | None
    """The slowest of the first plans, milliseconds."""
    plan_mean_ms: float | None
    """Mean planning time, milliseconds."""
    plan_p50_ms: float | None
    """Quantiles of the planning time, milliseconds, interpolated; of 2, 10, 100 and 1000 plans or more."""
    plan_p90_ms: float | None
    """See ``plan_p50_ms``."""
    plan_p99_ms: float | None
    """See ``plan_p50_ms``."""
    plan_p99_9_ms: float | None
    """See ``plan_p50_ms``."""
    plan_max_ms: float | None
    """Longest planning time, milliseconds."""
    plan_jitter_ms: float | None
    """Standard deviation of the planning time, milliseconds."""
    plans_per_second: float | None
    """Plans finished in a second of the wall clock."""
    deadline_ms: float
    """What a plan has, milliseconds: 1 / rate, or the plant's period."""
    misses: int
    """Plans that took longer than that."""
    miss_share: float | None
    """Their share of the plans."""
    blind_plans: int | None
    """Plans, the first ones included, of which no sample was good: such a plan is the last one, moved forward."""
    known_plans: int
    """Plans, the first ones included, of which that is known."""
    failed_share: float | None
    """Share of the samples of these plans that failed."""
    effective_samples_mean: float | None
    """Mean of the effective number of samples of a plan: 1 if a single one decides, 0 if none is good."""
    tick_jitter_ms: float | None
    """Standard deviation of how late the plant's steps began, milliseconds; None if it waits for its plans."""
    tick_delay_max_ms: float | None
    """The most that a step began after its time, milliseconds."""
    late_ticks: int | None
    """Steps that began late because the plant had not done the one before."""
    age_mean_ms: float
    """Mean age of the applied actions, milliseconds; see ``Trajectory.ages``."""
    age_max_ms: float
    """Greatest age of them."""
    age_steps_mean: float
    """Mean age in steps of the plant, of which each lasts a period; 0 if it waits for its plans."""
    age_steps_max: int
    """Greatest age in steps: 1 if the controller kept up. (A step that is applied a moment after its time makes the
    age in milliseconds a little more than the period.)"""
    real_time_factor: float
    """Simulated seconds in a second of the wall clock, over everything."""
    episode_seconds_mean: float
    """Mean duration of an episode by the wall clock, seconds."""
    return_mean: float
    """Mean return."""
    return_std: float | None
    """Standard deviation of the returns, of a sample (n - 1)."""
    eval_mean: float
    """Mean of the evaluation metric at the end."""
    success: float
    """Share of the episodes whose goal was met at the end."""
    success_low: float
    """Lower bound of Wilson's 95 % interval of that share (Wilson 1927)."""
    success_high: float
    """Upper bound of it."""
    params: Mapping[str, Any]
    """The task's parameters."""
    controller: Mapping[str, Any]
    """What planned, with its settings; see ``Trajectory.controller``."""
    versions: Mapping[str, Any]
    """Packages, Python and machine, of the first trajectory."""

    def to_json(self) -> str:
        """Everything as JSON, of finite numbers only: null stands for what is missing or infinite."""
        return json.dumps(_finite(dataclasses.asdict(self)), indent=2, allow_nan=False)

    def write(self, path: str | Path) -> Path:
        """Write the JSON into a file, in one go.

        Returns:
            The file's path.
        """
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(path.name + ".tmp")
        try:
            temporary.write_text(self.to_json() + "\n")
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        return path

    def rows(self) -> list[tuple[str, str]]:
        """What to print: labels, and numbers with their units; "-" for what is missing."""
        rows = [
            ("episodes", f"{self.episodes} of {self.task} ({self.steps} steps, {self.mode})"),
            ("return", _text(self.return_mean, ".4g") + _text(self.return_std, ".2g", " ± {}", "")),
            ("evaluation at the end", _text(self.eval_mean, ".3g")),
            ("success", f"{self.success:.0%} (95 %: {self.success_low:.0%} to {self.success_high:.0%})"),
            ("seconds an episode", _text(self.episode_seconds_mean, ".3g", "{} s")),
            ("real-time factor", _text(self.real_time_factor, ".3g", "{} ×")),
            ("plans", f"{self.plans}" + _text(self.plans_per_second, ".4g", ", {} a second", "")),
            ("first plan", _text(self.first_plan_ms, ".3g", "{} ms")),
        ]
        for label, name in (("p50", "p50"), ("p90", "p90"), ("p99", "p99"), ("p99.9", "p99_9"), ("max", "max")):
            rows.append((f"planning time {label}", _text(getattr(self, f"plan_{name}_ms"), ".3g", "{} ms")))
        missed = f"{self.misses} of {self.plans}" + _text(self.miss_share, ".1%", " ({})", "")
        rows += [
            ("planning jitter (std)", _text(self.plan_jitter_ms, ".2g", "{} ms")),
            (f"missed deadlines ({self.deadline_ms:.4g} ms)", missed),
            ("age of the action, mean", _age(self.age_steps_mean, self.age_mean_ms)),
            ("age of the action, max", _age(self.age_steps_max, self.age_max_ms)),
        ]
        if self.blind_plans is not None:
            rows.append(("plans without a good sample", f"{self.blind_plans} of {self.known_plans}"))
        if self.failed_share is not None:
            rows.append(("failed samples", f"{100 * self.failed_share:.3g} %"))
        if self.effective_samples_mean is not None:
            rows.append(("effective samples, mean", _text(self.effective_samples_mean, ".3g")))
        if self.mode == "async":
            rows += [
                ("tick jitter (std)", _text(self.tick_jitter_ms, ".2g", "{} ms")),
                ("tick delay, max", _text(self.tick_delay_max_ms, ".2g", "{} ms")),
                ("late ticks", f"{self.late_ticks} of {self.steps}"),
            ]
        return rows


def control_report(trajectories: Trajectory | Sequence[Trajectory], *, rate: float | None = None) -> ControlReport:
    """Sum up how a controller did in one or many episodes.

    Args:
        trajectories: Episodes of one task, with plants that ran alike and the same controller.
        rate: Plans a second that the controller is asked for, which makes the deadline; by default the plant's.

    Raises:
        ValueError: There are none, they don't belong together, or the rate is no positive number.
    """
    episodes = [trajectories] if isinstance(trajectories, Trajectory) else list(trajectories)
    if not episodes:
        raise ValueError("a report needs a trajectory at least")
    first = episodes[0]
    for name in ("task", "engine", "mode", "timestep", "period"):
        if len(values := {getattr(episode, name) for episode in episodes}) > 1:
            raise ValueError(f"these trajectories differ in their {name} ({values}): make a report of each kind")
    for name in ("params", "controller"):
        if names := _differing([getattr(episode, name) for episode in episodes]):
            raise ValueError(
                f"these trajectories differ in their {name} ({', '.join(names)}): make a report of each kind"
            )
    if rate is not None and not (isinstance(rate, (int, float)) and 0 < rate < math.inf):
        raise ValueError(f"rate has to be plans a second, a positive number, not {rate!r}")
    deadline = first.period if rate is None else 1 / rate
    times = _joined(episode.plan_times[1:] for episode in episodes)
    ages = _joined(episode.ages for episode in episodes)
    age_steps = _joined(episode.age_steps for episode in episodes)
    returns = np.array([episode.episode_return for episode in episodes])
    wall, steps = sum(episode.wall_seconds for episode in episodes), sum(episode.steps for episode in episodes)
    misses, successes = int((times > deadline).sum()), sum(episode.succeeded for episode in episodes)
    low, high = wilson(successes, len(episodes))
    return ControlReport(
        task=first.task, engine=first.engine, mode=first.mode, episodes=len(episodes), steps=steps, plans=len(times),
        first_plan_ms=1000 * max(float(episode.plan_times[0]) for episode in episodes),
        plan_mean_ms=1000 * float(times.mean()) if len(times) else None,
        **_quantiles(1000 * times),
        plan_max_ms=1000 * float(times.max()) if len(times) else None,
        plan_jitter_ms=_std(1000 * times),
        plans_per_second=_plans_per_second(episodes),
        deadline_ms=1000 * deadline, misses=misses, miss_share=misses / len(times) if len(times) else None,
        **_samples(episodes), **_ticks(episodes),
        age_mean_ms=1000 * float(ages.mean()), age_max_ms=1000 * float(ages.max()),
        age_steps_mean=float(age_steps.mean()), age_steps_max=int(age_steps.max()),
        real_time_factor=steps * first.timestep / wall, episode_seconds_mean=wall / len(episodes),
        return_mean=float(returns.mean()), return_std=_std(returns),
        eval_mean=float(np.mean([float(episode.evals[-1]) for episode in episodes])),
        success=successes / len(episodes), success_low=low, success_high=high,
        params=first.params, controller=first.controller, versions=first.versions,
    )  # fmt: skip


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's interval of a share at 95 % (Wilson 1927): within 0 and 1, and of some width even at 0 and 1."""
    z = 1.959963984540054
    share = successes / trials
    middle = share + z * z / (2 * trials)
    spread = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    low, high = ((middle + sign * spread) / (1 + z * z / trials) for sign in (-1, 1))
    return max(0.0, low), min(1.0, high)


def _quantiles(times: np.ndarray) -> dict[str, Any]:
    return {
        f"plan_{name}_ms": float(np.quantile(times, q)) if len(times) >= enough else None
        for name, (q, enough) in _QUANTILES.items()
    }


def _differing(mappings: Sequence[Mapping[str, Any]]) -> list[str]:
    """What these mappings don't agree on."""
    names = dict.fromkeys(name for mapping in mappings for name in mapping)
    # as text, in which a NaN equals itself
    return [name for name in names if len({json.dumps(mapping.get(name)) for mapping in mappings}) > 1]


def _samples(episodes: Sequence[Trajectory]) -> dict[str, Any]:
    """How good the plans' samples were, of the plans of which it is known."""
    failed, effective = (_joined(getattr(e, name) for e in episodes) for name in ("plan_failed", "plan_effective"))
    failed, effective = failed[np.isfinite(failed)], effective[np.isfinite(effective)]
    samples = episodes[0].controller.get("samples")
    known = isinstance(samples, int) and samples > 0 and len(failed) > 0
    return {
        "blind_plans": int((failed >= samples).sum()) if known else None,
        "known_plans": len(failed) if known else 0,
        "failed_share": float(failed.mean() / samples) if known else None,
        "effective_samples_mean": float(effective.mean()) if len(effective) else None,
    }


def _ticks(episodes: Sequence[Trajectory]) -> dict[str, Any]:
    """How the steps of a plant that keeps its rate began, against its schedule."""
    if episodes[0].mode == "sync":
        return {"tick_jitter_ms": None, "tick_delay_max_ms": None, "late_ticks": None}
    delays = 1000 * _joined(episode.times - episode.period * torch.arange(episode.steps) for episode in episodes)
    return {
        "tick_jitter_ms": _std(delays),
        "tick_delay_max_ms": float(delays.max()),
        "late_ticks": sum(int(episode.late.sum()) for episode in episodes),
    }


def _plans_per_second(episodes: Sequence[Trajectory]) -> float | None:
    """Without the first plans, and without the time that they took of the clock."""
    plans, seconds = 0, 0.0
    for episode in episodes:
        ends = episode.plan_starts + episode.plan_times
        plans += int((ends[1:] <= episode.wall_seconds).sum())  # one may have ended after the plant
        seconds += episode.wall_seconds - max(0.0, float(ends[0]))
    return plans / seconds if plans and seconds > 0 else None


def _std(values: np.ndarray) -> float | None:
    """Standard deviation of a sample; None of one, and of numbers that are not finite."""
    return float(values.std(ddof=1)) if len(values) > 1 and np.isfinite(values).all() else None


def _joined(parts: Any) -> np.ndarray:
    return torch.cat(list(parts)).numpy()


def _text(value: float | None, form: str, around: str = "{}", missing: str = "-") -> str:
    if value is None or not math.isfinite(value):
        return missing
    return around.format(format(value, form if abs(value) < 1000 else ".0f"))


def _age(steps: float, milliseconds: float) -> str:
    return _text(milliseconds, ".3g", f"{steps:.3g} {'step' if steps == 1 else 'steps'} ({{}} ms)")


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
