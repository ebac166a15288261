"""List the tasks: lyceum-warp tasks."""

import dataclasses
import inspect
import sys
import textwrap
from pathlib import Path
from typing import Annotated, Any

import tyro

from lyceum_warp.binding import TaskSource, defaults, find_task, layouts_of, task_names, task_spec
from lyceum_warp.cli.display import console
from lyceum_warp.core import ModelFile, Task, find_model

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
        texts = {name: (_description(find_task(name)), _source(find_task(name))) for name in task_names()}
        names = [name for name in texts if self.word.lower() in " ".join((name, *texts[name])).lower()]
        if not names:
            raise ValueError(
                f"no task has {self.word!r} in its name, description or model: list all tasks with lyceum-warp tasks"
            )
        width = max(map(len, names))
        heading = _row("task".ljust(width), "obs", "act", "skip", "dt", "horizon", "model")
        console.print(heading, style="bold")
        for name in names:
            task = find_task(name)
            note = ""
            source = TaskSource(task)
            params = defaults(source.params, source.defaults)
            layouts = layouts_of(source, params)
            obs = sum(layouts.obs["policy"].values())
            actions = step = "-"
            try:
                spec = task_spec(task)
                step = f"{spec.option.timestep * task.frame_skip:g} s"
                actions = str(len(spec.actuators) if layouts.actions is None else sum(layouts.actions.values()))
            except (ImportError, OSError, ValueError) as error:  # the package with the model is missing
                note = str(error)
            about, model = texts[name]
            row = _row(name.ljust(width), obs, actions, task.frame_skip, step, task.horizon or "none", model)
            console.print(row, markup=False)
            for text, style in ((about, "dim"), (note, "yellow")):
                indented = textwrap.indent(textwrap.fill(text, min(console.width, 100) - 4), "    ")
                console.print(indented, style=style, soft_wrap=True, markup=False, end="\n" * bool(text))
        console.print(_LEGEND, style="dim", soft_wrap=True)


def _row(name: str, obs: Any, actions: Any, frame_skip: Any, step: str, horizon: Any, model: str) -> str:
    return f"{name}  {obs:>3}  {actions:>3}  {frame_skip:>4}  {step:>7}  {horizon:>7}  {model}"


def _description(task: type[Task]) -> str:
    text = vars(task).get("__doc__") or inspect.getdoc(sys.modules[task.__module__]) or ""
    line = text.partition("\n")[0].rstrip(".")
    physics = f" (physics: {', '.join(task.physics)})" if task.physics else ""
    return f"{line.partition(': ')[2] or line}{physics}"


def _source(task: type[Task]) -> str:
    model: Any = task.model() if callable(task.model) else task.model
    if not isinstance(model, str | ModelFile):
        return f"made in {task.__module__.rpartition('.')[2]}.py"
    file = model if isinstance(model, ModelFile) else find_model(model, task)
    if not isinstance(file, ModelFile):
        return file.name
    extra = getattr(file, "install", "").partition("[")[2].partition("]")[0]
    return f"{file.source} [{extra}]" if extra else f"{file.source}: {Path(file.file).name}"
