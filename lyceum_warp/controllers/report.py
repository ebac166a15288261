"""Summarise trajectories in a report: returns, success, planning times, missed deadlines."""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.support.files import replace_text
from lyceum_warp.support.mappings import differing
from lyceum_warp.support.validate import positive_number


@dataclasses.dataclass(frozen=True)
class ControlReport:
    """Statistics of a controller's episodes, computed by ``control_report``.

    A value is None if it does not apply, if the controller does not report it, or if there are too few plans. The first
    plan of each trajectory is slow, because it loads kernels and captures graphs. Statistics of planning times
    therefore exclude the first plan; see ``first_plan_ms``.
    """

    task: str
    """Name of the task."""
    engine: str
    """Name of the plant's engine."""
    mode: str
    """"sync" if the plant waited for each plan, "async" if it ran in real time."""
    episodes: int
    """Number of trajectories."""
    steps: int
    """Total number of steps."""
    plans: int
    """Number of plans, excluding the first plan of each trajectory."""
    first_plan_ms: float | None
    """Longest planning time, in milliseconds, among the first plans of all trajectories."""
    plan_mean_ms: float | None
    """Mean planning time, in milliseconds."""
    plan_p50_ms: float | None
    """Median planning time, in milliseconds; None with fewer than 2 plans. Quantiles are interpolated."""
    plan_p90_ms: float | None
    """90 % quantile of the planning time, in milliseconds; None with fewer than 10 plans."""
    plan_p99_ms: float | None
    """99 % quantile of the planning time, in milliseconds; None with fewer than 100 plans."""
    plan_p99_9_ms: float | None
    """99.9 % quantile of the planning time, in milliseconds; None with fewer than 1000 plans."""
    plan_max_ms: float | None
    """Longest planning time, in milliseconds."""
    plan_jitter_ms: float | None
    """Standard deviation of the planning time, in milliseconds."""
    plans_per_second: float | None
    """Finished plans per second of wall time."""
    deadline_ms: float
    """Deadline for the planning time, in milliseconds: 1 / ``rate``, or the plant's period."""
    misses: int
    """Number of plans with a planning time above the deadline."""
    miss_share: float | None
    """Fraction of plans with a planning time above the deadline."""
    blind_plans: int | None
    """Number of plans whose samples all failed, so that the planner only shifted the previous plan in time."""
    known_plans: int
    """Number of plans, including first plans, for which the controller reports failed samples."""
    failed_share: float | None
    """Fraction of failed samples in the plans that ``known_plans`` counts."""
    effective_samples_mean: float | None
    """Mean effective sample size of a plan: 1 if one sample has all the weight, 0 if all samples failed."""
    tick_jitter_ms: float | None
    """Standard deviation of the delays of plant steps, in milliseconds; None in a synchronous run."""
    tick_delay_max_ms: float | None
    """Longest delay of a step, in milliseconds."""
    late_ticks: int | None
    """Number of steps that started late because the previous step took too long."""
    age_mean_ms: float
    """Mean age of the applied actions, in milliseconds; see ``Trajectory.ages``."""
    age_max_ms: float
    """Maximum age of the applied actions, in milliseconds."""
    age_steps_mean: float
    """Mean age of the applied actions, in steps of the plant."""
    age_steps_max: int
    """Maximum age of the applied actions, in plant steps; 1 if every plan was finished in time."""
    real_time_factor: float
    """Simulated seconds per second of wall time."""
    episode_seconds_mean: float
    """Mean wall time of an episode, in seconds."""
    return_mean: float
    """Mean return."""
    return_std: float | None
    """Sample standard deviation (n - 1) of the returns."""
    eval_mean: float
    """Mean evaluation metric in the last state of an episode."""
    success: float
    """Fraction of episodes that end in success."""
    success_low: float
    """Lower bound of the 95 % confidence interval of ``success`` (Wilson 1927)."""
    success_high: float
    """Upper bound of the 95 % confidence interval of ``success``."""
    params: Mapping[str, Any]
    """Parameters of the task."""
    controller: Mapping[str, Any]
    """Name and settings of the controller; see ``Trajectory.controller``."""
    versions: Mapping[str, Any]
    """Versions of Python and packages, and the machine, from the first trajectory."""

    def to_json(self) -> str:
        """Convert the report to JSON. Missing and non-finite numbers become null."""
        return json.dumps(_finite(dataclasses.asdict(self)), indent=2, allow_nan=False)

    def write(self, path: str | Path) -> Path:
        """Write the report as JSON, atomically, and return the file's path."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_text(path, self.to_json() + "\n")
        return path

    def rows(self) -> list[tuple[str, str]]:
        """Format the report as pairs: a label, and a number with its unit, or "-"."""
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
    """Make a report on one or many episodes of a controller.

    Args:
        trajectories: Episodes with the same task, engine, mode and controller.
        rate: Required plans per second. A plan's deadline is 1 / ``rate``. By default, the deadline is the plant's
            period.

    Raises:
        ValueError: There is no trajectory, or the rate is not positive. Trajectories must also agree in task, engine,
            mode and controller.
    """
    episodes = [trajectories] if isinstance(trajectories, Trajectory) else list(trajectories)
    if not episodes:
        raise ValueError("a report needs at least one trajectory")
    first = episodes[0]
    for name in ("task", "engine", "mode", "timestep", "period"):
        if len(values := {getattr(episode, name) for episode in episodes}) > 1:
            raise ValueError(f"these trajectories differ in their {name} ({values}): make separate reports")
    for name in ("params", "controller"):
        if names := differing([getattr(episode, name) for episode in episodes]):
            raise ValueError(f"these trajectories differ in their {name} ({', '.join(names)}): make separate reports")
    deadline = first.period if rate is None else 1 / positive_number("rate", rate, "plans per second")
    common = ("task", "engine", "mode", "params", "controller", "versions")
    return ControlReport(
        **{name: getattr(first, name) for name in common},
        episodes=len(episodes),
        steps=sum(episode.steps for episode in episodes),
        **_planning_times(episodes, deadline),
        **_plan_quality(episodes),
        **_step_times(episodes),
        **_results(episodes),
    )


def _planning_times(episodes: Sequence[Trajectory], deadline: float) -> dict[str, Any]:
    times = _joined(episode.plan_times[1:] for episode in episodes)
    milliseconds, misses = 1000 * times, int((times > deadline).sum())
    quantiles = {"p50": (0.5, 2), "p90": (0.9, 10), "p99": (0.99, 100), "p99_9": (0.999, 1000), "max": (1.0, 1)}
    return {
        "plans": len(times),
        "first_plan_ms": 1000 * max(float(episode.plan_times[0]) for episode in episodes),
        "plan_mean_ms": _mean(milliseconds),
        **{f"plan_{name}_ms": _quantile(milliseconds, q, least) for name, (q, least) in quantiles.items()},
        "plan_jitter_ms": _std(milliseconds),
        "plans_per_second": _plans_per_second(episodes),
        "deadline_ms": 1000 * deadline,
        "misses": misses,
        "miss_share": misses / len(times) if len(times) else None,
    }


def _plan_quality(episodes: Sequence[Trajectory]) -> dict[str, Any]:
    failed = _joined(episode.plan_failed for episode in episodes)
    effective = _joined(episode.plan_effective for episode in episodes)
    failed, samples = failed[np.isfinite(failed)], episodes[0].controller.get("samples")
    counts = isinstance(samples, int) and samples > 0 and len(failed) > 0
    return {
        "blind_plans": int((failed >= samples).sum()) if counts else None,
        "known_plans": len(failed) if counts else 0,
        "failed_share": float(failed.mean() / samples) if counts else None,
        "effective_samples_mean": _mean(effective[np.isfinite(effective)]),
    }


def _step_times(episodes: Sequence[Trajectory]) -> dict[str, Any]:
    ages, age_steps = _joined(e.ages for e in episodes), _joined(e.age_steps for e in episodes)
    delays = 1000 * _joined(episode.times - episode.period * torch.arange(episode.steps) for episode in episodes)
    timed = episodes[0].mode == "async"
    return {
        "tick_jitter_ms": _std(delays) if timed else None,
        "tick_delay_max_ms": float(delays.max()) if timed else None,
        "late_ticks": sum(int(episode.late.sum()) for episode in episodes) if timed else None,
        "age_mean_ms": 1000 * float(ages.mean()),
        "age_max_ms": 1000 * float(ages.max()),
        "age_steps_mean": float(age_steps.mean()),
        "age_steps_max": int(age_steps.max()),
    }


def _results(episodes: Sequence[Trajectory]) -> dict[str, Any]:
    wall_seconds = sum(episode.wall_seconds for episode in episodes)
    seconds = sum(episode.steps for episode in episodes) * episodes[0].timestep
    returns = np.array([episode.episode_return for episode in episodes])
    successes = sum(episode.succeeded for episode in episodes)
    low, high = wilson(successes, len(episodes))
    return {
        "real_time_factor": seconds / wall_seconds,
        "episode_seconds_mean": wall_seconds / len(episodes),
        "return_mean": float(returns.mean()),
        "return_std": _std(returns),
        "eval_mean": float(np.mean([float(episode.evals[-1]) for episode in episodes])),
        "success": successes / len(episodes),
        "success_low": low,
        "success_high": high,
    }


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


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Compute Wilson's 95 % confidence interval of a proportion (Wilson 1927)."""
    z = 1.959963984540054
    share = successes / trials
    middle = share + z * z / (2 * trials)
    spread = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    width = 1 + z * z / trials
    return max(0.0, (middle - spread) / width), min(1.0, (middle + spread) / width)


def _joined(parts: Iterable[torch.Tensor]) -> np.ndarray:
    return torch.cat(list(parts)).numpy()


def _std(values: np.ndarray) -> float | None:
    return float(values.std(ddof=1)) if len(values) > 1 and np.isfinite(values).all() else None


def _mean(values: np.ndarray) -> float | None:
    return float(values.mean()) if len(values) else None


def _quantile(values: np.ndarray, q: float, least: int) -> float | None:
    return float(np.quantile(values, q)) if len(values) >= least else None


def _plans_per_second(episodes: Sequence[Trajectory]) -> float | None:
    plans, seconds = 0, 0.0
    for episode in episodes:
        ends = episode.plan_starts + episode.plan_times
        plans += int((ends[1:] <= episode.wall_seconds).sum())  # the last plan may end after the plant has stopped
        seconds += episode.wall_seconds - max(0.0, float(ends[0]))
    return plans / seconds if plans and seconds > 0 else None
