"""Plot runs and compare them: lyceum-warp plot."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from lyceum_warp import training
from lyceum_warp.cli.display import console, say_entries, table, table_of
from lyceum_warp.support.intervals import bootstrap_interval, interquartile_mean, mean_interval
from lyceum_warp.support.mappings import differing


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plot:
    """Plot the curves of runs over samples and seconds, and compare their final returns, settings and versions.

    Runs with the same settings are one group, whatever their seeds: the plot shows its mean and a 95 % interval
    (percentile bootstrap). A folder stands for all runs in it. A folder with files for TensorBoard is read as a run of
    rsl_rl or Stable-Baselines3. For a single run, the plot shows its reward terms, metrics and ends of episodes, too.

    $ lyceum-warp plot runs/hopper-20260101-120000
    $ lyceum-warp plot runs/hopper-npg runs/hopper-ppo --out comparison.png
    $ lyceum-warp plot runs/go1 logs/rsl_rl/go1/2026-01-01_12-00-00
    """

    folders: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUN|FOLDER ...")]
    """Folders of runs, or folders that contain runs."""
    out: Path = Path("comparison.png")
    """The file of the plot of several runs, such as .png, .pdf or .svg. The curve of a single run is curve.png in its
    folder."""

    def run(self) -> None:
        if not self.folders:
            raise ValueError("plot needs the folder of a run, or a folder of runs")
        curves = training.read_curves(self.folders)
        groups = training.group_runs(curves)
        print_groups(groups)
        if len(groups) > 1:
            _print_differences(groups[:4])
        alone = len(curves) == 1 and (curves[0].folder / "config.json").is_file()
        path = training.learning_curve(curves[0].folder) if alone else training.comparison_figure(groups, self.out)
        say_entries(figure=path, next=f"lyceum-warp report {curves[0].folder}")


def print_groups(groups: "list[training.RunGroup]") -> None:
    """Print the final returns of groups of runs with the samples before them, gates, and verdicts on transfer.

    The interval of the mean is Student's t interval. That of the interquartile mean is a percentile bootstrap interval,
    as in Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice".
    """
    rows = []
    for group in groups:
        finals = np.array([run.final for run in group.curves] or [math.nan])
        mean, half = mean_interval(finals)
        samples = sorted({run.samples[-1] for run in group.curves})
        tested = [run.gate.startswith("passed") for run in group.runs if run.gate]
        rows.append({
            "task": group.task, "settings": group.label, "runs": str(len(group.runs)),
            "samples": " to ".join(f"{number:,.0f}" for number in (*samples[:1], *samples[1:][-1:])),
            "policy": " or ".join(sorted({"mean" if run.evaluated else "stochastic" for run in group.curves})),
            "final return\n[95 %, t]": _interval(mean, mean - half, mean + half),
            "interquartile mean\n[95 %, bootstrap]":
                _interval(float(interquartile_mean(finals)), *bootstrap_interval(finals, interquartile_mean)),
            "gate": f"{sum(tested)} of {len(tested)} passed" if tested else "",
            "transfer": "; ".join(dict.fromkeys(run.transfer for run in group.runs if run.transfer)),
        })  # fmt: skip
    console.print(table_of(rows))


def _interval(value: float, low: float, high: float) -> str:
    return f"{value:.5g}" + ("" if math.isnan(low) else f" [{low:.5g}, {high:.5g}]")


def _print_differences(groups: "list[training.RunGroup]") -> None:
    """Print the settings and the versions in which groups differ, one group a column."""
    entries = {}
    for k, group in enumerate(groups, 1):
        settings, versions = group.runs[0].settings, group.runs[0].versions
        # without prefixes, a hyperparameter of two algorithms is in one row
        short_names = {name.removeprefix(f"{settings['algorithm']}."): value for name, value in settings.items()}
        entries[f"{k}: {group.label}"] = {**short_names, **versions}
    if names := differing([*entries.values()]):
        cells = {heading: [str(each.get(name, "")) for name in names] for heading, each in entries.items()}
        console.print(table({"difference": names, **cells}))
