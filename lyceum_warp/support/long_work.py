"""Show the progress of long work: a temporary bar on a terminal, otherwise lines."""

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


class LongWork(Progress):
    """Shows the progress of long work: a temporary bar on a terminal, otherwise a line every 10 s.

    Args:
        text: A description of the work, such as "compiling kernels".
        unit: The name of the counted units, such as "frames".
        console: The output; by default stderr.
        wait: Seconds until the first line.
    """

    def __init__(self, text: str, unit: str, console: Console | None = None, *, wait: float = 3.0) -> None:
        console = console or Console(highlight=False, stderr=True)
        super().__init__(
            TextColumn("{task.description}"), BarColumn(bar_width=12), MofNCompleteColumn(), TextColumn(unit),
            TimeElapsedColumn(), console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self.text, self.unit, self.bar = text, unit, self.add_task(text, total=None)
        self.began, self.next_line = time.monotonic(), wait

    def __call__(self, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` units are complete."""
        self.update(self.bar, completed=done, total=total)
        seconds = time.monotonic() - self.began
        if not self.console.is_terminal and seconds >= self.next_line and done < total:
            self.console.print(f"{self.text}: {done} of {total} {self.unit}, {seconds:.0f} s", soft_wrap=True)
            self.console.file.flush()
            self.next_line = seconds + 10.0
