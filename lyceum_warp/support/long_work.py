"""Show the progress of long work: a temporary bar on a terminal, otherwise lines."""

import time

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn


class LongWork:
    """Shows the progress of long work: a temporary bar on a terminal, otherwise a line every 10 s.

    Args:
        text: The name of the work.
        unit: The name of the counted units, such as "frames".
        console: The output; by default stderr.
        wait: Seconds until the first line.
    """

    def __init__(self, text: str, unit: str, console: Console | None = None, *, wait: float = 3.0) -> None:
        self.text, self.unit, self.console = text, unit, console or Console(highlight=False, stderr=True)
        self.progress = Progress(
            TextColumn("{task.description}"), BarColumn(bar_width=12), MofNCompleteColumn(), TextColumn(unit),
            TimeElapsedColumn(), console=self.console, transient=True, disable=not self.console.is_terminal,
        )  # fmt: skip
        self.bar = self.progress.add_task(text, total=None)
        self.start, self.next = time.monotonic(), wait

    def __enter__(self) -> "LongWork":
        self.progress.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.progress.stop()

    def __call__(self, done: int, total: int) -> None:
        """Show how many of all units are done."""
        self.progress.update(self.bar, completed=done, total=total)
        seconds = time.monotonic() - self.start
        if not self.console.is_terminal and seconds >= self.next and done < total:
            self.console.print(f"{self.text}: {done} of {total} {self.unit}, {seconds:.0f} s", soft_wrap=True)
            self.console.file.flush()
            self.next = seconds + 10.0
