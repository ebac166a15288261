"""lyceum-warp tasks."""

import dataclasses
import inspect
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import mujoco
import tyro
from rich.markup import escape

from lyceum_warp.binding.bound_task import obs_layouts, task_spec
from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.binding.models import compile_model, find_model
from lyceum_warp.binding.parameters import defaults
from lyceum_warp.binding.registry import find_task, task_names
from lyceum_warp.cli.display import make_console
from lyceum_warp.model_files import ModelFile, PackageFile
from lyceum_warp.options import PhysicsOptions
from lyceum_warp.task import Task

_HEADINGS = ("task", "obs", "act", "skip", "dt", "horizon", "model")
_RIGHT = slice(1, 6)
"""The columns of numbers."""

_LEGEND = """obs, act: numbers in an observation and an action; skip: substeps in a step; dt: seconds in a step.
A task of your own: lyceum-warp new --help"""

_UNKNOWN = "-"

_ONE_CONTROL = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE, mujoco.mjtGain.mjGAIN_MUSCLE)
"""Types of actuators that have one control each."""

_WIDTH = 100
"""Columns that a description may take."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Tasks:
    """List the tasks that come with the package: their sizes, and where their models come from.

    A task whose model comes with an extra or with MuJoCo Menagerie is listed also where that is not installed, with
    what it needs.

    $ lyceum-warp tasks
    $ lyceum-warp tasks gymnasium
    """

    word: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WORD")] = ""
    """Only tasks with this word in their name, their description or the source of their model."""

    def run(self) -> int:
        """Run the command; returns the exit code."""
        entries = [entry for entry in map(_entry, task_names()) if entry.found(self.word)]
        if not entries:
            raise ValueError(
                f"no task has {self.word!r} in its name, description or model: lyceum-warp tasks lists all"
            )
        rows, notes = zip(*map(_row, entries), strict=True)
        table = [_HEADINGS, *rows]
        widths = [max(len(row[i]) for row in table) for i in range(len(_HEADINGS))]
        sides: list[Callable[[str, int], str]] = [str.ljust] * len(_HEADINGS)
        sides[_RIGHT] = [str.rjust] * len(sides[_RIGHT])
        heading, *lines = (
            "  ".join(side(*cell) for side, *cell in zip(sides, row, widths, strict=True)) for row in table
        )
        console = make_console()

        def show(text: str, style: str = "", indent: str = "") -> None:
            if indent:
                text = textwrap.fill(text, min(console.width, _WIDTH), initial_indent=indent, subsequent_indent=indent)
            console.print(escape(text.rstrip()), style=style, soft_wrap=True)

        show(heading, "bold")
        for line, entry, note in zip(lines, entries, notes, strict=True):
            show(line)
            show(entry.about or _UNKNOWN, "dim", "    ")
            if note:
                show(note, "yellow", "    ")
        show("")
        show(_LEGEND, "dim")
        return 0


@dataclasses.dataclass(frozen=True)
class _Entry:
    """A task in the list. What its model must be read for is read on demand."""

    name: str
    task: type[Task] | None
    """None where the task's file cannot be run."""
    about: str
    source: str
    note: str
    """Why something of it is not known; empty where there is no reason."""

    def found(self, word: str) -> bool:
        """Whether the entry has a word, in any case."""
        return word.lower() in " ".join((self.name, self.about, self.source)).lower()


def _entry(name: str) -> _Entry:
    try:
        task = find_task(name)
    except Exception as error:  # a broken file may raise any
        return _Entry(name, None, "", _UNKNOWN, _reason(error))
    about = (inspect.getdoc(sys.modules[task.__module__]) or "").partition("\n")[0]
    about = (about.partition(": ")[2] or about).rstrip(".")
    try:
        return _Entry(name, task, about, _source(task), "")
    except Exception as error:
        return _Entry(name, task, about, _UNKNOWN, _reason(error))


def _row(entry: _Entry) -> tuple[tuple[str, ...], str]:
    """The cells of a task, and what keeps the model's from being known."""
    task, note = entry.task, entry.note
    if task is None:
        return (entry.name, *[_UNKNOWN] * (len(_HEADINGS) - 2), entry.source), note
    obs = actions = timestep = _UNKNOWN
    try:
        actions = _UNKNOWN if task.actions is None else str(sum(task.actions.values()))
        obs = str(sum(obs_layouts(task, defaults(TaskSource(task, entry.name).params))["policy"].values()))
        spec = task_spec(task)
        actions = str(_controls(spec)) if task.actions is None else actions
        timestep = f"{spec.option.timestep * task.frame_skip:g} s"
    except Exception as error:  # a package that is not installed, with a model's files, or a mistake in the task
        note = note or _reason(error)
    numbers = (obs, actions, str(task.frame_skip), timestep, str(task.horizon or "none"))
    return (entry.name, *numbers, entry.source), note


def _controls(spec: mujoco.MjSpec) -> int:
    """The number of a model's controls; the model is compiled only where an actuator may have several.

    To compile the meshes of a robot takes up to a second.
    """
    if all(actuator.gaintype in _ONE_CONTROL for actuator in spec.actuators):
        return len(spec.actuators)
    return compile_model(spec, (), PhysicsOptions()).nu


def _source(task: type[Task]) -> str:
    """What brings a task's model, with its extra where it has one."""
    model: Any = task.model() if callable(task.model) else task.model
    if not isinstance(model, str | ModelFile):
        return f"made in {task.__module__.rpartition('.')[2]}.py"
    found = model if isinstance(model, ModelFile) else find_model(model, task)
    if not isinstance(found, ModelFile):
        return found.name
    extra = found.install.partition("[")[2].partition("]")[0] if isinstance(found, PackageFile) else ""
    return f"{found.source} [{extra}]" if extra else f"{found.source}: {Path(found.file).name}"


def _reason(error: Exception) -> str:
    """An error in one line; the command that fixes it alone, where the error names one."""
    text = " ".join(str(error).split())
    command = text.rpartition(": ")[2]
    if command.startswith("pip install"):
        return f"needs: {command}"
    return text if isinstance(error, ImportError | OSError | ValueError) else f"{type(error).__name__}: {text}"
