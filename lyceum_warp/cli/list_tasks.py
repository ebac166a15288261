"""lyceum-warp tasks."""

import dataclasses
import inspect
import sys

import rich.box
from rich.table import Table

from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.binding.registry import find_task, task_names
from lyceum_warp.cli.display import make_console


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tasks:
    """List the tasks that come with the package, with their sizes."""


def list_tasks() -> int:
    """The command."""
    table = Table(box=rich.box.SIMPLE)
    for heading, side in [("task", "left"), ("obs", "right"), ("action", "right"), ("substeps", "right"),
                          ("timestep", "right"), ("horizon", "right"), ("", "left")]:  # fmt: skip
        table.add_column(heading, justify=side, no_wrap=bool(heading))  # type: ignore[arg-type]
    for name in task_names():
        task = BoundTask(find_task(name))
        about = (inspect.getdoc(sys.modules[find_task(name).__module__]) or "").partition("\n")[0]
        about = (about.partition(": ")[2] or about).rstrip(".")
        sizes = (sum(task.obs_layout.values()), task.model.nu, task.frame_skip)
        horizon = str(task.task.horizon or "none")
        table.add_row(name, *map(str, sizes), f"{task.timestep:g} s", horizon, about)
    console = make_console()
    console.print(table)
    console.print("[dim]timestep: seconds in a step, all its substeps together. A task of your own: path/to/file.py[/]")
    return 0


# lyceum-warp train
