"""Plot episodes of a controller."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lyceum_warp.controllers import Trajectory
from lyceum_warp.viz.style import ACCENT, LINE, finish_axes, new_figure, save_png


def control_plot(episodes: Sequence[Trajectory], out: str | Path) -> Path:
    """Plot episodes of a controller as PNG.

    The left side shows reward and evaluation metric against simulated time. The right side shows planning times and
    ages of actions against wall time. Dashed lines show the deadline.

    Args:
        episodes: Episodes of the same task, at least one. The first one's control period is the deadline.
        out: The PNG file.

    Raises:
        ImportError: matplotlib is not installed.
    """
    figure = new_figure("a controller's episodes", 10.0, 6.5)
    (reward, planning), (evaluation, age) = figure.subplots(2, 2, sharex="col")
    _plot_outcomes(reward, evaluation, episodes)
    _plot_times(planning, age, episodes)
    finish_axes((reward, evaluation, planning, age))
    first = episodes[0]
    figure.suptitle(f"{first.task}, {first.engine}, {first.mode}", x=0.01, ha="left")
    return save_png(figure, out)


def _line_style(episodes: Sequence[Trajectory]) -> dict[str, Any]:
    return dict(color=LINE, linewidth=1.2, alpha=max(0.25, 1 / len(episodes) ** 0.5))


def _plot_outcomes(reward: Any, evaluation: Any, episodes: Sequence[Trajectory]) -> None:
    for episode in episodes:
        line = _line_style(episodes) | {"marker": "." if episode.steps < 3 else ""}  # a line of one point is invisible
        seconds = episode.timestep * np.arange(1, episode.steps + 1)
        reward.plot(seconds, episode.rewards, **line)
        evaluation.plot(seconds, episode.evals, **line)
        if episode.succeeded:
            evaluation.plot(seconds[-1], episode.evals[-1], color=ACCENT, marker="o", markersize=4, linestyle="")
    reward.set_ylabel("reward")
    evaluation.set_ylabel("evaluation metric")
    evaluation.set_xlabel("simulated time (s)")
    if any(episode.succeeded for episode in episodes):
        evaluation.plot([], [], color=ACCENT, marker="o", markersize=4, linestyle="", label="success at the end")
        evaluation.legend(frameon=False, loc="best")


def _plot_times(planning: Any, age: Any, episodes: Sequence[Trajectory]) -> None:
    dots = _line_style(episodes) | {"linestyle": "", "marker": ".", "markersize": 3}
    for episode in episodes:
        # skip the first plan: it loads kernels, and its time would dominate the scale
        planning.plot(episode.plan_starts[1:], 1000 * episode.plan_times[1:], **dots)
        age.plot(episode.times, 1000 * episode.ages, **dots)
    deadline = 1000 * episodes[0].period
    planning.axhline(deadline, color=ACCENT, linestyle="--", linewidth=1, label=f"deadline, {deadline:.3g} ms")
    age.axhline(deadline, color=ACCENT, linestyle="--", linewidth=1, label="one period")
    planning.legend(frameon=False, loc="best")
    age.legend(frameon=False, loc="best")
    planning.set_ylabel("planning (ms)")
    age.set_ylabel("age of action (ms)")
    age.set_xlabel("wall clock (s)")
    for axes in (planning, age):
        axes.set_ylim(bottom=0)
