"""List the tasks: lyceum-warp tasks."""

import dataclasses
import inspect
import sys
import textwrap
from pathlib import Path
from typing import Annotated, Any

import mujoco
import tyro
from rich.markup import escape

from lyceum_warp.binding import (
    TaskSource,
    compile_model,
    defaults,
    find_model,
    find_task,
    length,
    obs_layouts,
    task_names,
    task_spec,
)
from lyceum_warp.cli.display import console
from lyceum_warp.core import ModelFile, PhysicsOptions, Task

_HEADINGS = ("task", "obs", "act", "skip", "dt", "horizon", "model")

_LEGEND = """obs, act: numbers in an observation and an action; skip: substeps in a step; dt: seconds in a step.
To write your own task: lyceum-warp new --help"""

_UNKNOWN = "-"

_ONE_CONTROL = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE, mujoco.mjtGain.mjGAIN_MUSCLE)

_WIDTH = 100


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
        entries = list(map(_entry, task_names()))
        entries = [one for one in entries if self.word.lower() in f"{one.name} {one.about} {one.source}".lower()]
        if not entries:
            raise ValueError(
                f"no task has {self.word!r} in its name, description or model: list all tasks with lyceum-warp tasks"
            )
        table = [_HEADINGS, *map(_cells, entries)]
        widths = [max(len(row[i]) for row in table) for i in range(len(_HEADINGS))]
        fits = sum(widths) + 2 * len(widths) - 2 <= console.width
        shown = len(_HEADINGS) - (not fits)  # in a narrow console, the model gets its own line
        heading, *lines = (
            "  ".join(f"{cell:{'>' if 1 <= i <= 5 else '<'}{widths[i]}}" for i, cell in enumerate(row[:shown]))
            for row in table
        )
        indented: dict[str, Any] = {"width": min(console.width, _WIDTH)}
        indented |= dict.fromkeys(("initial_indent", "subsequent_indent"), "    ")
        console.print(heading.rstrip(), style="bold", soft_wrap=True)
        for line, entry in zip(lines, entries, strict=True):
            console.print(escape(line.rstrip()), soft_wrap=True)
            about = entry.about + f"; model: {entry.source}" * (not fits)
            console.print(escape(textwrap.fill(about, **indented)), style="dim", soft_wrap=True)
            if entry.note:
                console.print(escape(textwrap.fill(entry.note, **indented)), style="yellow", soft_wrap=True)
        console.print(f"\n{_LEGEND}", style="dim", soft_wrap=True)


@dataclasses.dataclass
class _Entry:
    name: str
    task: type[Task] | None = None
    about: str = _UNKNOWN
    source: str = _UNKNOWN
    note: str = ""


def _entry(name: str) -> _Entry:
    """Make a task's entry without the sizes, because these require the model."""
    entry = _Entry(name)
    try:
        task = entry.task = find_task(name)
        text = vars(task).get("__doc__") or inspect.getdoc(sys.modules[task.__module__]) or ""
        about = text.partition("\n")[0]
        entry.about = (about.partition(": ")[2] or about).rstrip(".") or _UNKNOWN
        entry.about += f" (physics: {', '.join(task.physics)})" * bool(task.physics)
        entry.source = _source(task)
    except Exception as error:  # importing a broken task file may raise any error
        entry.note = _reason(error)
    return entry


def _cells(entry: _Entry) -> tuple[str, ...]:
    """Return the cells of a task's row. If the model cannot be loaded, set the entry's note."""
    task = entry.task
    if task is None:
        return (entry.name, *[_UNKNOWN] * 5, entry.source)
    obs = actions = timestep = _UNKNOWN
    try:
        source = TaskSource(task, entry.name)
        params = defaults(source.params, source.defaults)
        if task.actions is not None:
            actions = str(sum(length(f"the size of {name}", size, params) for name, size in task.actions.items()))
        obs = str(sum(obs_layouts(source, params)["policy"].values()))
        spec = task_spec(task)
        actions = str(_controls(spec)) if task.actions is None else actions
        timestep = f"{spec.option.timestep * task.frame_skip:g} s"
    except Exception as error:  # the package with the model may be missing, or the task may be wrong
        entry.note = entry.note or _reason(error)
    return (entry.name, obs, actions, str(task.frame_skip), timestep, str(task.horizon or "none"), entry.source)


def _controls(spec: mujoco.MjSpec) -> int:
    """Return the number of a model's controls. Compile the model only if necessary, because this can take a second."""
    if all(actuator.gaintype in _ONE_CONTROL for actuator in spec.actuators):
        return len(spec.actuators)
    return compile_model(spec, (), PhysicsOptions()).nu


def _source(task: type[Task]) -> str:
    model: Any = task.model() if callable(task.model) else task.model
    if not isinstance(model, str | ModelFile):
        return f"made in {task.__module__.rpartition('.')[2]}.py"
    found = model if isinstance(model, ModelFile) else find_model(model, task)
    if not isinstance(found, ModelFile):
        return found.name
    extra = getattr(found, "install", "").partition("[")[2].partition("]")[0]
    return f"{found.source} [{extra}]" if extra else f"{found.source}: {Path(found.file).name}"


def _reason(error: Exception) -> str:
    """Shorten an error to the pip command that it contains, or to one line."""
    text = " ".join(str(error).split())
    command = text.rpartition(": ")[2]
    if command.startswith("pip install"):
        return f"needs: {command}"
    return text if isinstance(error, ImportError | OSError | ValueError) else f"{type(error).__name__}: {text}"
