"""Trajectories of controlled worlds: what happened, when, and a report of how well the controller kept up."""

import dataclasses
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lyceum_warp.env import Env
from lyceum_warp.kernels.faults import Done
from lyceum_warp.versions import versions

FORMAT = 1
"""Format of the file; one more whenever an older release could no longer read it."""

# every array of a trajectory: its type and axes, of which those with the same name have the same length
_ARRAYS = {
    "states": (torch.float64, ("steps + 1", "state_size")), "obs": (torch.float32, ("steps + 1", "nobs")),
    "actions": (torch.float32, ("steps", "nu")), "rewards": (torch.float32, ("steps",)),
    "evals": (torch.float32, ("steps",)), "success": (torch.bool, ("steps",)),
    "times": (torch.float64, ("steps",)), "ages": (torch.float64, ("steps",)), "late": (torch.bool, ("steps",)),
    "plan_of": (torch.int64, ("steps",)), "plan_steps": (torch.int64, ("plans",)),
    "plan_starts": (torch.float64, ("plans",)), "plan_times": (torch.float64, ("plans",)),
}  # fmt: skip
_SCALARS = {
    "timestep": float, "period": float, "wall_seconds": float, "mode": str, "done_reason": int, "task": str,
    "engine": str, "params": dict, "versions": dict,
}  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Trajectory:
    """One episode of one world under a controller. All tensors lie on the CPU.

    Step k leads from state k to state k + 1 under action k. ``set_state`` of the first state and the actions give
    all the others again, to the bit, on the engine that they come from.

    Times are seconds of the wall clock since the run's clock started: with the first plan in a synchronous run, after
    it in an asynchronous one.
    """

    states: torch.Tensor
    """States, (steps + 1, state_size) float64. After a fault the last one is where the world began again."""
    obs: torch.Tensor
    """Observations of the states, (steps + 1, nobs) float32. After a fault the last one is the last good one."""
    actions: torch.Tensor
    """Actions that were applied, (steps, nu) float32."""
    rewards: torch.Tensor
    """Rewards, (steps,) float32."""
    evals: torch.Tensor
    """The evaluation metric of the states that the steps led to, (steps,) float32."""
    success: torch.Tensor
    """Whether the task's goal was met there, (steps,) bool."""
    times: torch.Tensor
    """When each action was applied, (steps,) float64, seconds."""
    ages: torch.Tensor
    """How old each action was then, (steps,) float64, seconds: the time since the plant was in the state that the
    action was planned from. A plant that waits has not moved meanwhile: there it is what the plan took."""
    late: torch.Tensor
    """Whether a step began late because the one before it was not done in time, (steps,) bool; never if the plant
    waits."""
    plan_of: torch.Tensor
    """Which plan each action came from, (steps,) int64."""
    plan_steps: torch.Tensor
    """The step whose state each plan was made from, (plans,) int64."""
    plan_starts: torch.Tensor
    """When each plan was begun, (plans,) float64, seconds; negative for the first one of an asynchronous run."""
    plan_times: torch.Tensor
    """How long each plan took until its actions were there, (plans,) float64, seconds."""
    timestep: float
    """Simulated seconds in a step."""
    period: float
    """Seconds of the wall clock that a step has: at which the plant runs, or would run in real time if it waits."""
    wall_seconds: float
    """Seconds of the wall clock that all of it took."""
    mode: str
    """"sync" if the plant waited for its plans, "async" if it kept its rate."""
    done_reason: int
    """Bits of ``Done``: why the episode ended; 0 if it went on."""
    task: str
    """Name of the task."""
    engine: str
    """Name of the engine."""
    params: Mapping[str, Any]
    """The task's parameters."""
    versions: Mapping[str, Any]
    """Packages, Python, machine and commit."""

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.actions)

    @property
    def episode_return(self) -> float:
        """Sum of the rewards."""
        return float(self.rewards.double().sum())

    @property
    def terminated(self) -> bool:
        """Whether the task, or a fault, ended the episode."""
        return bool(self.done_reason & ~Done.TRUNCATED)

    @property
    def truncated(self) -> bool:
        """Whether the time limit was reached."""
        return bool(self.done_reason & Done.TRUNCATED)

    @property
    def succeeded(self) -> bool:
        """Whether the task's goal was met at the end."""
        return bool(self.success[-1])

    @property
    def age_steps(self) -> torch.Tensor:
        """Steps between the state that each action was planned from and the action, (steps,) int64."""
        return torch.arange(self.steps) - self.plan_steps[self.plan_of]

    def save(self, path: str | Path) -> Path:
        """Write everything into one file, in one go: a reader finds the old file or the whole new one.

        The file is a compressed ``.npz``, which numpy reads by itself, without pickle. Each array has the name, the
        shape, the type and the unit of the attribute; ``info`` is JSON text, a string of no axis, with ``format``
        (1), ``task``, ``engine``, ``params``, ``versions``, ``mode``, ``timestep``, ``period``, ``wall_seconds`` and
        ``done_reason``.

        Returns:
            The file's path.
        """
        path = Path(path)
        info = {"format": FORMAT, **{name: getattr(self, name) for name in _SCALARS}}
        arrays: dict[str, Any] = {name: getattr(self, name).numpy() for name in _ARRAYS}
        arrays["info"] = np.array(json.dumps(info))
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(path.name + ".tmp")
        try:
            with temporary.open("wb") as file:  # by name, numpy would add a suffix
                np.savez_compressed(file, **arrays)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        return path

    @classmethod
    def load(cls, path: str | Path) -> "Trajectory":
        """Read a file that ``save`` wrote. Nothing in it is run.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is broken, foreign, or of a newer release.
        """
        path = Path(path)
        try:
            with np.load(path, allow_pickle=False) as file:
                info = json.loads(str(file["info"]))
                if info["format"] <= FORMAT:
                    content: dict[str, Any] = {name: torch.from_numpy(file[name]) for name in _ARRAYS}
                    _check(content)
                    return cls(**content, **{name: kind(info[name]) for name, kind in _SCALARS.items()})
        except OSError:
            raise
        except Exception as error:  # numpy and zipfile raise many kinds, depending on where the file is broken
            text = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise ValueError(f"{path} is broken, or is no trajectory of lyceum_warp ({text[:200]})") from error
        raise ValueError(
            f"{path} was written by a newer lyceum_warp (format {info['format']}, this one reads up to {FORMAT}): "
            "pip install --upgrade lyceum-warp"
        )


def _check(arrays: Mapping[str, torch.Tensor]) -> None:
    """Refuse arrays that don't belong together."""
    steps = len(arrays["actions"])
    lengths = {"steps": steps, "steps + 1": steps + 1, "plans": len(arrays["plan_times"])}
    for name, (dtype, axes) in _ARRAYS.items():
        array = arrays[name]
        fits = array.ndim == len(axes) and array.dtype == dtype and len(array) == lengths[axes[0]]
        if not fits or not len(array):
            raise ValueError(f"{name} has type {array.dtype} and shape {tuple(array.shape)}")
    if not ((arrays["plan_of"] >= 0) & (arrays["plan_of"] < lengths["plans"])).all():
        raise ValueError("plan_of names plans that are not there")


def provenance(env: Env) -> dict[str, Any]:
    """What a trajectory tells of where it comes from: ``task``, ``engine``, ``params`` and ``versions``."""
    params = {name: np.asarray(value).tolist() for name, value in env.task.params.items()}
    device = env.device.alias
    return {"task": env.task.name, "engine": env.engine.name, "params": params, "versions": versions(device)}


# the report

# of how many plans a quantile can be told: of fewer, none would lie beyond it
_QUANTILES = {"p50": (0.5, 2), "p90": (0.9, 10), "p99": (0.99, 100), "p99_9": (0.999, 1000)}


@dataclasses.dataclass(frozen=True)
class ControlReport:
    """How a controller did, and how well it kept up with its plant; see ``control_report``.

    None stands for what there is too little of, or what there is not. The first plan of each trajectory is told of
    apart, and in no other number about plans: it alone loads kernels and makes recordings.
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
    """Greatest age in steps."""
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
    """The task's parameters, of the first trajectory."""
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
            ("age of the action, mean", _text(self.age_mean_ms, ".3g", f"{{}} ms ({self.age_steps_mean:.3g} steps)")),
            ("age of the action, max", _text(self.age_max_ms, ".3g", f"{{}} ms ({self.age_steps_max} steps)")),
        ]
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
        trajectories: Episodes of one task, with plants that ran alike.
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
        **_ticks(episodes),
        age_mean_ms=1000 * float(ages.mean()), age_max_ms=1000 * float(ages.max()),
        age_steps_mean=float(age_steps.mean()), age_steps_max=int(age_steps.max()),
        real_time_factor=steps * first.timestep / wall, episode_seconds_mean=wall / len(episodes),
        return_mean=float(returns.mean()), return_std=_std(returns),
        eval_mean=float(np.mean([float(episode.evals[-1]) for episode in episodes])),
        success=successes / len(episodes), success_low=low, success_high=high,
        params=first.params, versions=first.versions,
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


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
