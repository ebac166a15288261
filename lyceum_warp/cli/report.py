"""Write a page on a run: lyceum-warp report."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from lyceum_warp import training
from lyceum_warp.cli.display import say_entries


@dataclasses.dataclass(frozen=True, kw_only=True)
class Report:
    """Write one HTML page on a run: its settings, curves, verdicts, faults, machine and an episode that can be turned.

    The page needs no network and no other file. It has no absolute paths, user names or host names.

    $ lyceum-warp report runs/hopper-20260101-120000
    $ lyceum-warp report runs/hopper-20260101-120000 --out hopper.html
    """

    folder: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """The folder of a training run, or of a planner's episodes."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """The file; by default report.html in the folder."""

    def run(self) -> None:
        say_entries(report=training.write_report(self.folder, self.out), next="open or send it: it needs no other file")
