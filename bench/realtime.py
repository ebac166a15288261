"""A world that keeps its own rate while MPPI plans for it, and again with a planner that is slowed on purpose.

    python bench/realtime.py reach --seconds 60

The report says how many plans came too late, how old the applied actions were, and how evenly the world was stepped.
Nothing else should run on the machine meanwhile.
"""

import dataclasses
import json
import time
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw
from lyceum_warp.viz.control_plot import control_plot


@dataclasses.dataclass(frozen=True)
class Options:
    """Control against the clock."""

    task: tyro.conf.Positional[str] = "reach"
    """Task, with its own settings of MPPI."""
    seconds: float = 60.0
    """Seconds of the wall clock."""
    slow: float = 2.5
    """Periods that the slowed planner takes at least."""
    nthread: int | None = None
    """Threads of the planner; all cores by default."""
    out: Path | None = None
    """JSON file for the reports; a plot of the first run comes beside it."""


class Slowed:
    """A planner that waits after each plan until a given time has passed."""

    def __init__(self, plan: lw.MPPI, seconds: float) -> None:
        self.plan, self.seconds = plan, seconds
        self.timestep, self.reset, self.samples = plan.timestep, plan.reset, plan.samples

    @property
    def actions(self) -> torch.Tensor:
        return self.plan.actions

    @property
    def summary(self) -> dict[str, float]:
        return self.plan.summary

    def __call__(self, state: torch.Tensor, obs: torch.Tensor, *, shift: int = 1) -> torch.Tensor:
        due = time.perf_counter() + self.seconds
        action = self.plan(state, obs, shift=shift)
        time.sleep(max(0.0, due - time.perf_counter()))
        return action


def main(options: Options) -> None:
    torch.set_num_threads(1)
    plan = lw.MPPI(options.task, nthread=options.nthread)
    reports = {}
    for name in ("as it is", "slowed"):
        # one long episode, so that only the clock ends it
        env = lw.make(options.task, autoreset=False, horizon=0, nthread=1)
        controller = plan if name == "as it is" else Slowed(plan, options.slow * env.timestep)
        done = lw.control_async(env, controller, seconds=options.seconds, seed=0)
        reports[name] = lw.control_report(done)
        if options.out is not None and name == "as it is":
            control_plot(done, options.out.with_suffix(".png"), title=f"{options.task}, {1 / env.timestep:.0f} Hz")
    table = Table("", *reports)
    for rows in zip(*(report.rows() for report in reports.values()), strict=True):
        table.add_row(rows[0][0], *(value for _, value in rows))
    Console(width=110).print(table)
    if options.out is not None:
        contents = {name: json.loads(report.to_json()) for name, report in reports.items()}
        options.out.write_text(json.dumps(contents, indent=2) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
