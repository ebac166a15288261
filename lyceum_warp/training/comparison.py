"""Compare runs: curves over samples and seconds with intervals, final returns, and settings that differ."""

import dataclasses
import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lyceum_warp.support.extras import check_extra
from lyceum_warp.support.intervals import bootstrap_interval
from lyceum_warp.support.mappings import differing, flat_settings
from lyceum_warp.training.runs.folder import Run
from lyceum_warp.viz import STYLES, finish_axes, new_figure, save_figure

_SETTINGS = ("algorithm", "network", "nworld", "engine", "device", "exact_from", "options", "params", "physics")
"""Entries of config.json that tell one kind of run from another, besides the algorithm's own."""

_POINTS, _RESAMPLES = 200, 1000
"""Numbers of points of a mean curve, and of bootstrap resamples of its interval."""


@dataclasses.dataclass(frozen=True)
class RunCurve:
    """The learning curve of a run, and what the run is."""

    folder: Path
    task: str
    """Name of the task; empty for a run of another library."""
    settings: Mapping[str, Any]
    """Settings by name, without the seed."""
    versions: Mapping[str, Any]
    """Versions of packages, the machine and the commit."""
    samples: np.ndarray
    """Samples at each point, (n,)."""
    seconds: np.ndarray
    """Seconds of sampling and updates at each point, (n,), without evaluations. For another library, seconds since the
    first point."""
    returns: np.ndarray
    """Return of the mean policy at each point, (n,), or that of the sampled episodes if there is no evaluation."""
    evaluated: bool
    """Whether the returns are those of the mean policy."""
    gate: str = ""
    """Whether a policy has passed the gate of the task, if it was tested."""
    transfer: str = ""
    """The verdict of the transfer test, if there was one."""

    @property
    def final(self) -> float:
        """The last return."""
        return float(self.returns[-1]) if len(self.returns) else math.nan


@dataclasses.dataclass(frozen=True)
class RunGroup:
    """Runs with the same task and settings."""

    task: str
    label: str
    """The settings that differ from those of other groups."""
    runs: Sequence[RunCurve]

    @property
    def curves(self) -> list[RunCurve]:
        """The runs that have a return."""
        return [run for run in self.runs if len(run.returns)]


def read_curves(paths: Iterable[str | Path]) -> list[RunCurve]:
    """Read the curves of runs.

    Args:
        paths: Folders of runs, or folders that contain them at any depth. Folders with files for TensorBoard are read
            as runs of rsl_rl or Stable-Baselines3.

    Raises:
        FileNotFoundError: A path has no run.
        ValueError: A run cannot be read.
        ImportError: Files for TensorBoard need the package tensorboard.
    """
    curves = []
    for path in map(Path, paths):
        if folders := sorted(file.parent for file in path.rglob("metrics.csv")):
            curves += [read_curve(Run.open(folder)) for folder in folders]
        elif folders := sorted({file.parent for file in path.rglob("events.out.tfevents.*")}):
            curves += map(_read_events, folders)
        else:
            curves.append(read_curve(Run.open(path)))  # or an error that names what is there
    return curves


def read_curve(run: Run) -> RunCurve:
    """Read the curve of a run. Iterations without a return are left out."""
    rows = run.rows() if run.metrics.exists() else []
    seconds = list(itertools.accumulate(map(row_seconds, rows)))
    for column in ("mean_return", "return_mean"):
        table = [(row["samples"], second, row.get(column)) for row, second in zip(rows, seconds, strict=True)]
        points = np.array(table, float).reshape(-1, 3)
        if len(points := points[np.isfinite(points[:, 2])]):
            break
    config, passed = run.config, run.config.get("passed")
    gate = "not passed" if (run.folder / "gate.jsonl").exists() else ""
    return RunCurve(
        folder=run.folder,
        task=run.task_name,
        settings=flat_settings({name: config.get(name) for name in (*_SETTINGS, str(config.get("algorithm")))}),
        versions={**config.get("versions", {}), "task source": run.manifest.get("source_hash", "")[:12]},
        samples=points[:, 0], seconds=points[:, 1], returns=points[:, 2], evaluated=column == "mean_return",
        gate=gate if passed is None else f"passed in iteration {passed['iteration']}",
        transfer=json.loads(run.transfer.read_text()).get("line", "") if run.transfer.is_file() else "",
    )  # fmt: skip


def row_seconds(row: Mapping[str, float | None]) -> float:
    """Sum the seconds of sampling and updates in a row of metrics.csv, without those of evaluations."""
    return sum(value or 0.0 for name, value in row.items() if name.startswith("time_") and name != "time_mean")


def _read_events(folder: Path) -> RunCurve:
    """Read a run of rsl_rl or Stable-Baselines3 from its files for TensorBoard."""
    check_extra(f"reading {folder}", "tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()

    def column(tag: str) -> np.ndarray:
        if tag not in events.Tags()["scalars"]:
            raise ValueError(f"{folder} has no curve {tag!r}, which rsl_rl and Stable-Baselines3 write")
        return np.array([(event.step, event.wall_time, event.value) for event in events.Scalars(tag)])

    if "rollout/ep_rew_mean" in events.Tags()["scalars"]:
        points, library = column("rollout/ep_rew_mean"), "stable-baselines3"
        samples = points[:, 0]
    else:
        points, library = column("Train/mean_reward"), "rsl_rl"
        rate, sampling, learning = (column(f"Perf/{tag}") for tag in ("total_fps", "collection_time", "learning_time"))
        # rsl_rl counts iterations, and rounds the rate down
        each = np.round(np.median((rate[:, 2] + 0.5) * (sampling[:, 2] + learning[:, 2])))
        samples = (points[:, 0] + 1) * each
    seconds = points[:, 1] - points[0, 1]
    return RunCurve(folder, "", {"algorithm": library}, {}, samples, seconds, points[:, 2], evaluated=False)


def group_runs(curves: Sequence[RunCurve]) -> list[RunGroup]:
    """Group runs by task and settings. A group's label names the settings that differ from other groups'."""
    tasks = list(dict.fromkeys(curve.task for curve in curves if curve.task)) or [""]
    kinds: dict[tuple[str, str], list[RunCurve]] = {}
    for curve in curves:
        if not curve.task and len(tasks) > 1:
            raise ValueError(f"{curve.folder} names no task: compare it with runs of one task")
        key = json.dumps(curve.settings, sort_keys=True, default=str)
        kinds.setdefault((curve.task or tasks[0], key), []).append(curve)
    groups = []
    for (task, _), runs in kinds.items():
        settings = [others[0].settings for (other, _), others in kinds.items() if other == task]
        varied = [name for name in differing(settings) if all(name in each for each in settings)]
        differences = [f"{name.rpartition('.')[2]} {runs[0].settings[name]}" for name in varied or ["algorithm"]]
        groups.append(RunGroup(task, ", ".join(differences).removeprefix("algorithm "), runs))
    return groups


def comparison_figure(groups: Sequence[RunGroup], out: str | Path) -> Path:
    """Plot the mean return of each group over samples and over seconds, with 95 % intervals (percentile bootstrap).

    A run that ends before the others of its group counts with its last return from there on. The suffix of the file
    chooses the format, such as .pdf or .png.

    Raises:
        ValueError: No run has a return.
        ImportError: matplotlib is not installed.
    """
    tasks = list(dict.fromkeys(group.task for group in groups if group.curves))
    if not tasks:
        raise ValueError("no run has a return to plot: continue its training")
    figure = new_figure("a comparison", 9.0, 0.6 + 2.9 * len(tasks))
    from matplotlib.ticker import EngFormatter

    for task, panels in zip(tasks, figure.subplots(len(tasks), 2, squeeze=False, sharey="row"), strict=True):
        shown = [group for group in groups if group.task == task and group.curves]
        for group, (colour, _, line) in zip(shown, itertools.cycle(STYLES)):
            label = f"{group.label} ({len(group.curves)} run{'s' * (len(group.curves) > 1)})"
            for axes, name in zip(panels, ("samples", "seconds"), strict=True):
                x, mean, low, high = mean_curve(group.curves, name)
                axes.plot(x, mean, color=colour, linestyle=line, label=label, marker="" if len(set(x)) > 2 else ".")
                axes.fill_between(x, low, high, color=colour, alpha=0.2, linewidth=0)
        evaluated = all(run.evaluated for group in shown for run in group.curves)
        panels[0].set_title(task, loc="left")
        panels[0].set(xlabel="samples", ylabel="return of the mean policy" if evaluated else "return")
        panels[0].legend(title="mean, 95 % interval", frameon=False, fontsize="small", title_fontsize="small")
        panels[1].set_xlabel("seconds of sampling and updates")
        panels[0].xaxis.set_major_formatter(EngFormatter(sep=""))
        finish_axes(panels)
    return save_figure(figure, out)


def mean_curve(runs: Sequence[RunCurve], over: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Compute the mean curve of runs, and the ends of its 95 % interval (percentile bootstrap over several runs).

    Args:
        runs: The runs, each with at least one return.
        over: "samples" or "seconds".

    Returns:
        The samples or seconds, the mean, and the lower and upper ends, each (points,).
    """
    xs = [getattr(run, over) for run in runs]
    x = xs[0] if len(xs) == 1 else np.linspace(max(each[0] for each in xs), max(each[-1] for each in xs), _POINTS)
    values = np.stack([np.interp(x, each, run.returns) for each, run in zip(xs, runs, strict=True)], axis=-1)
    return x, values.mean(-1), *bootstrap_interval(values, lambda rows: rows.mean(-1), resamples=_RESAMPLES)
