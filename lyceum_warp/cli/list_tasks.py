"""lyceum-warp tasks."""

import dataclasses
import inspect
import sys

import rich.box
from rich.markup import escape
from rich.table import Table

from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.binding.registry import find_task, task_names
from lyceum_warp.cli.display import make_console

_COLUMNS = (("task", "left"), ("obs", "right"), ("action", "right"), ("substeps", "right"), ("timestep", "right"),
            ("horizon", "right"), ("", "left"))  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tasks:
    """List the tasks that come with the package, with their sizes."""


def list_tasks() -> int:
    """Run the command; returns the exit code."""
    table = Table(box=rich.box.SIMPLE)
    for heading, side in _COLUMNS:
        table.add_column(heading, justify=side, no_wrap=bool(heading))  # type: ignore[arg-type]
    for name in task_names():
        table.add_row(*map(escape, _row(name)))
    console = make_console()
    console.print(table)
    console.print("[dim]timestep: seconds in a step, all its substeps together. A task of your own: path/to/file.py[/]")
    return 0


def _row(name: str) -> tuple[str, ...]:
    """The cells of a task; the last one holds a description, and where it cannot be made here the reason."""
    about = ""
    try:
        task_class = find_task(name)
        about = (inspect.getdoc(sys.modules[task_class.__module__]) or "").partition("\n")[0]
        about = (about.partition(": ")[2] or about).rstrip(".")
        task = BoundTask(task_class)
    except (ImportError, OSError, ValueError) as error:  # such as a package that is not installed, with a model's files
        return name, *["-"] * (len(_COLUMNS) - 2), "; ".join(filter(None, (about, _reason(error))))
    sizes = (sum(task.obs_layout.values()), task.model.nu, task.frame_skip)
    return name, *map(str, sizes), f"{task.timestep:g} s", str(task.task.horizon or "none"), about


def _reason(error: Exception) -> str:
    """An error in one line; the command that fixes it alone, where the error names one."""
    text = " ".join(str(error).split())
    command = text.rpartition(": ")[2]
    return f"needs: {command}" if command.startswith("pip install") else text
