"""Reports on controlled worlds: how the episodes went, and whether the controller kept up with its plant."""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lyceum_warp.controllers.control_statistics import (
    age_statistics,
    differing_names,
    outcome_statistics,
    plan_statistics,
    sample_statistics,
    tick_statistics,
)
from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.support.docstrings import document_attributes
from lyceum_warp.support.files import replaced
from lyceum_warp.support.validate import positive_number


@document_attributes
@dataclasses.dataclass(frozen=True)
class ControlReport:
    """Statistics of a controller's episodes; ``control_report`` makes it.

    A value is None if there are too few plans for it, if it does not apply, or if the controller does not report it.
    The first plan of each trajectory loads kernels and captures graphs. It counts in ``first_plan_ms``, and in no other
    number about planning times.
    """

    task: str
    """Name of the task."""
    engine: str
    """Name of the plant's engine."""
    mode: str
    """"sync" if the plant waited for each plan, "async" if it kept its rate."""
    episodes: int
    """Number of trajectories."""
    steps: int
    """Number of steps of all trajectories."""
    plans: int
    """Number of plans, without the first ones."""
    first_plan_ms: float | None
    """Longest planning time of the first plans, milliseconds."""
    plan_mean_ms: float | None
    """Mean planning time, milliseconds."""
    plan_p50_ms: float | None
    """Median of the planning time, milliseconds, interpolated; of at least 2 plans."""
    plan_p90_ms: float | None
    """90 % quantile of the planning time, milliseconds; of at least 10 plans."""
    plan_p99_ms: float | None
    """99 % quantile of the planning time, milliseconds; of at least 100 plans."""
    plan_p99_9_ms: float | None
    """99.9 % quantile of the planning time, milliseconds; of at least 1000 plans."""
    plan_max_ms: float | None
    """Longest planning time, milliseconds."""
    plan_jitter_ms: float | None
    """Standard deviation of the planning time, milliseconds."""
    plans_per_second: float | None
    """Finished plans per second of the wall clock."""
    deadline_ms: float
    """Deadline of a plan, milliseconds: 1 / rate, or the plant's period."""
    misses: int
    """Number of plans that took longer than the deadline."""
    miss_share: float | None
    """Share of the plans that took longer than the deadline."""
    blind_plans: int | None
    """Number of plans whose samples all failed, the first plans included. Such a plan is the plan before it, moved
    forward."""
    known_plans: int
    """Number of plans for which the failed samples are known, the first plans included."""
    failed_share: float | None
    """Share of the samples of these plans that failed."""
    effective_samples_mean: float | None
    """Mean of the effective number of samples of a plan: 1 if a single sample decides, 0 if all failed."""
    tick_jitter_ms: float | None
    """Standard deviation of the delay of the plant's steps, milliseconds; None if the plant waits for its plans."""
    tick_delay_max_ms: float | None
    """Longest delay of a step, milliseconds."""
    late_ticks: int | None
    """Number of steps that began late because the step before was not finished in time."""
    age_mean_ms: float
    """Mean age of the applied actions, milliseconds; see ``Trajectory.ages``."""
    age_max_ms: float
    """Greatest age of the applied actions, milliseconds."""
    age_steps_mean: float
    """Mean age of the applied actions in steps of the plant; 0 if the plant waits for its plans."""
    age_steps_max: int
    """Greatest age in steps: 1 if the controller kept up. (In milliseconds it may then be slightly more than a period,
    because a step begins shortly after it is due.)"""
    real_time_factor: float
    """Simulated seconds per second of the wall clock, over all episodes."""
    episode_seconds_mean: float
    """Mean duration of an episode by the wall clock, seconds."""
    return_mean: float
    """Mean return."""
    return_std: float | None
    """Standard deviation of the returns, of a sample (n - 1)."""
    eval_mean: float
    """Mean of the evaluation metric at the end of the episodes."""
    success: float
    """Share of the episodes whose goal is met at the end."""
    success_low: float
    """Lower bound of the 95 % confidence interval of that share (Wilson 1927)."""
    success_high: float
    """Upper bound of that interval."""
    params: Mapping[str, Any]
    """Parameters of the task."""
    controller: Mapping[str, Any]
    """Name and settings of the controller; see ``Trajectory.controller``."""
    versions: Mapping[str, Any]
    """Packages, Python and machine of the first trajectory."""

    def to_json(self) -> str:
        """The report as JSON, with null for missing and for infinite numbers."""
        return json.dumps(_finite(dataclasses.asdict(self)), indent=2, allow_nan=False)

    def write(self, path: str | Path) -> Path:
        """Write the JSON to a file. A reader finds the old file or the whole new one.

        Returns:
            The file's path.
        """
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as temporary:
            temporary.write_text(self.to_json() + "\n")
        return path

    def rows(self) -> list[tuple[str, str]]:
        """The report as rows of text: a label, and a number with its unit or "-" if it is missing."""
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
        trajectories: Episodes of the same task, engine, mode and controller.
        rate: Required plans per second, which set the deadline; by default one plan in each of the plant's periods.

    Raises:
        ValueError: There is no trajectory, the trajectories are of different kinds, or the rate is not
            positive.
    """
    episodes = [trajectories] if isinstance(trajectories, Trajectory) else list(trajectories)
    if not episodes:
        raise ValueError("a report needs at least one trajectory")
    first = episodes[0]
    for name in ("task", "engine", "mode", "timestep", "period"):
        if len(values := {getattr(episode, name) for episode in episodes}) > 1:
            raise ValueError(f"these trajectories differ in their {name} ({values}): make a report of each kind")
    for name in ("params", "controller"):
        if names := differing_names([getattr(episode, name) for episode in episodes]):
            raise ValueError(
                f"these trajectories differ in their {name} ({', '.join(names)}): make a report of each kind"
            )
    deadline = first.period if rate is None else 1 / positive_number("rate", rate, "plans per second")
    return ControlReport(
        task=first.task, engine=first.engine, mode=first.mode, params=first.params, controller=first.controller,
        versions=first.versions, **outcome_statistics(episodes), **plan_statistics(episodes, deadline),
        **sample_statistics(episodes), **tick_statistics(episodes), **age_statistics(episodes),
    )  # fmt: skip


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
