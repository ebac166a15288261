"""List the tasks: lyceum-warp tasks.

The command reads a stored list, because loading all tasks and their models takes seconds. After a change of the
package's tasks, ``python docs/task_list.py`` stores a new list.
"""

import dataclasses
import importlib.util
import json
import textwrap
from pathlib import Path
from typing import Annotated, Any

import tyro

from lyceum_warp.cli.display import console

LIST = Path(__file__).resolve().parents[1] / "tasks" / "list.json"
"""The stored list: a row for each task, by name."""

_LEGEND = """
obs, act: numbers in an observation and an action; skip: substeps in a step; dt: seconds in a step.
To write your own task: lyceum-warp new --help"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tasks:
    """List the tasks of the package, their sizes and the sources of their models.

    If a task's model needs a package that is missing, the list names the package.

    $ lyceum-warp tasks
    $ lyceum-warp tasks gymnasium
    """

    word: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WORD")] = ""
    """List only tasks with this word in their name, description or model source."""

    def run(self) -> None:
        rows: dict[str, dict[str, Any]] = json.loads(LIST.read_text("utf-8"))
        names = [
            name for name, row in rows.items() if self.word.lower() in f"{name} {row['about']} {row['model']}".lower()
        ]
        if not names:
            raise ValueError(
                f"no task has {self.word!r} in its name, description or model: list all tasks with lyceum-warp tasks"
            )
        width = max(map(len, names))
        console.print(_line("task".ljust(width), "obs", "act", "skip", "dt", "horizon", "model"), style="bold")
        for name in names:
            row = rows[name]
            cells = (row["obs"], row["act"], row["skip"], f"{row['dt']:g} s", row["horizon"] or "none", row["model"])
            console.print(_line(name.ljust(width), *cells), markup=False)
            for text, style in ((row["about"], "dim"), (_missing(**row["files"]), "yellow")):
                indented = textwrap.indent(textwrap.fill(text, min(console.width, 100) - 4), "    ")
                console.print(indented, style=style, soft_wrap=True, markup=False, end="\n" * bool(text))
        console.print(_LEGEND, style="dim", soft_wrap=True)


def _line(name: str, obs: Any, actions: Any, frame_skip: Any, step: str, horizon: Any, model: str) -> str:
    return f"{name}  {obs:>3}  {actions:>3}  {frame_skip:>4}  {step:>7}  {horizon:>7}  {model}"


def _missing(packages: list[str], install: str) -> str:
    if not packages or any(map(importlib.util.find_spec, packages)):
        return ""
    return f"the model comes with the package {packages[0].replace('_', '-')}: pip install '{install}'"
