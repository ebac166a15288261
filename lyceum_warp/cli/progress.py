"""Show the progress of training."""

import math
import sys
import textwrap
from collections.abc import Iterable

from rich.console import Console, RenderableType
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from lyceum_warp.algos import Iteration, Learner, simulation
from lyceum_warp.cli.display import COUNTED, counted, known_values, say, table
from lyceum_warp.support.long_work import LongWork
from lyceum_warp.training import Callback, Run


class _Bar(Progress):
    """A bar as wide as the terminal, over a line of text."""

    text = ""

    def get_renderables(self) -> Iterable[RenderableType]:
        """Return the bar and the text."""
        return *super().get_renderables(), self.text


class Display(Callback):
    """Shows the progress of training: a live bar on a terminal, otherwise one line per iteration."""

    def __init__(self, console: Console, *, verbose: bool = False) -> None:
        self.console, self.verbose = console, verbose
        self.total = 0
        self.mean = math.nan
        self.long_work: LongWork | None = None
        self.progress = _Bar(
            BarColumn(bar_width=None), MofNCompleteColumn(), TextColumn("iterations"), TimeElapsedColumn(),
            TimeRemainingColumn(compact=True), TextColumn("left"),
            console=console, disable=not console.is_terminal, expand=True,
        )  # fmt: skip

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Print the task, its worlds and the run folder, and show a progress bar."""
        env, size = learner.env, learner.team.size
        processes = f" each in {size} processes" if size > 1 else ""
        self.console.print(
            f"[bold]{env.task.name}[/]: {env.obs_space.size} observations, {env.action_space.size} actions; "
            f"{env.nworld} worlds{processes}, {simulation(env)}, {learner.title}; run in {escape(str(run.folder))}",
            soft_wrap=True,
        )  # fmt: skip
        self.total, self.learner, self.simulation = iterations, learner, simulation(env)
        self.bar = self.progress.add_task("", total=iterations, completed=learner.iteration)
        self.progress.start()

    def end(self, run: Run, learner: Learner) -> None:
        """Print the faults."""
        counts = learner.env.fault_counts
        if kinds := ", ".join(f"{number:,d} {kind}" for kind, number in counts.items() if number):
            say(f"faults by their kind (lw.Done): {kinds}; lyceum-warp check names the function of a bad reward")

    def close(self) -> None:
        """End the progress bar."""
        self.progress.stop()

    def __call__(self, it: Iteration) -> None:
        """Show an iteration."""
        if (text := simulation(self.learner.env)) != self.simulation:
            self.console.print(f"from iteration {it.iteration} on: {text}", soft_wrap=True)
            self.simulation = text
        if it.mean_return is not None:
            self.mean = it.mean_return
        mean_return = self.mean if self.console.is_terminal or it.mean_return is not None else math.nan
        row = known_values(it.row())
        # the return is unknown until the first episode ends
        reward = f"reward {row['reward_mean']:.3g} a step" if "reward_mean" in row else ""
        result = f"return {row['return_mean']:.4g}" if "return_mean" in row else reward
        mean = "" if math.isnan(mean_return) else f"(mean policy {mean_return:.4g})"
        success = f"success {row['success']:.0%}" if "success" in row else ""
        bad = [counted(number, what) for column, what in COUNTED.items() if (number := row.get(column))]
        rate = f"{row['samples_per_second'] / 1000:.3g}k samples/s" if "samples_per_second" in row else ""
        loss = f"loss {row['loss']:.3g}" if "loss" in row else ""
        text = " ".join(filter(None, [result, loss, *bad, mean, success, rate]))
        if self.console.is_terminal:
            self.progress.text = escape(textwrap.shorten(text, self.console.width, placeholder="…"))
            self.progress.update(self.bar, completed=it.iteration)
        else:
            self.console.print(f"iteration {it.iteration:4d}/{self.total}  {text}", soft_wrap=True)
            sys.stdout.flush()
        if self.verbose and it.mean_return is not None:
            # no episode may have ended yet
            what, values = (
                ("sum of an episode", sums) if (sums := known_values(it.metrics)) else ("mean", it.step_metrics)
            )
            if values:
                cells = [f"{value:.4g}" for value in values.values()]
                self.console.print(table({f"iteration {it.iteration}": [*values], what: cells}))

    def work(self, text: str, unit: str, done: int, total: int) -> None:
        """Show the progress of work between two iterations, such as rendering a video."""
        if self.console.is_terminal:
            self.progress.text = escape(f"{text}: {done}/{total} {unit}")
            return
        if self.long_work is None or (self.long_work.text, self.long_work.unit) != (text, unit):
            self.long_work = LongWork(text, unit, self.console)
        self.long_work(done, total)
        if done >= total:
            self.long_work = None
