"""Load saved episodes, and make an environment that accepts their states."""

import grp
import os
import pwd
import stat
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lyceum_warp.binding.registry import find_task
from lyceum_warp.controllers.trajectory import Trajectory
from lyceum_warp.core.task import Task
from lyceum_warp.env.env import Env, make


def load_episodes(paths: str | Path | Iterable[str | Path]) -> dict[Path, Trajectory]:
    """Load episodes that have the same task and the same state layout.

    Args:
        paths: Files written by ``Trajectory.save``, ``lyceum-warp plan`` or ``lyceum-warp eval --episodes-to``. From a
            folder, all ``.npz`` files are loaded in alphabetical order.

    Raises:
        FileNotFoundError: A file does not exist, or a folder holds no episode.
        ValueError: A file is broken, comes from a newer release, or has a different task, model or pictures than the
            first file.
    """
    episodes: dict[Path, Trajectory] = {}
    for path in _files([paths] if isinstance(paths, str | Path) else paths):
        episodes[path] = episode = Trajectory.load(path)
        first_path, first = next(iter(episodes.items()))
        if episode.task != first.task:
            raise ValueError(
                f"{path} is an episode of the task {episode.task!r}, but {first_path} is an episode of the task "
                f"{first.task!r}: load the files separately"
            )
        if difference := _difference(first.state_parts, episode.state_parts):
            raise ValueError(f"{path} has a different model than {first_path}: its states have {difference}")
        sizes, first_sizes = ({g: tuple(p.shape[1:]) for g, p in each.pictures.items()} for each in (episode, first))
        if sizes != first_sizes:
            raise ValueError(f"{path} has pictures {sizes}, but {first_path} has {first_sizes}: load them separately")
    if not episodes:
        raise ValueError("there is no episode to load: pass at least one file")
    return episodes


def episode_env(
    episodes: Mapping[Path, Trajectory] | Trajectory, *, task: str | Path | type[Task] | None = None, **changes: Any
) -> Env:
    """Make an environment for the states of saved episodes, with one world and no automatic resets.

    The environment has the first episode's parameters, model and physics options. ``env.set_state`` accepts the states
    of all episodes.

    An episode's file contains the path of a task file. Making the environment runs this task file as Python code.
    Without ``task``, this user or root must therefore own the file and its folder, and no other user may have write
    access.

    Args:
        episodes: The episodes, as ``load_episodes`` returns them.
        task: The task, which must have the name of the episodes' task. The task is required if it comes from a
            notebook, if its file has moved, or if other users can write to the file.
        changes: Additional options and parameters of ``lw.make``.

    Raises:
        FileNotFoundError: The file of the task or of its model is missing.
        ValueError: The task is not found, differs from the episode's task, or does not fit the states. A task file to
            which other users can write is also refused.
    """
    if isinstance(episodes, Trajectory):
        episodes = {Path("the episode"): episodes}
    path, first = next(iter(episodes.items()))
    definition = _task(path, first, task)
    kwargs = {"autoreset": False, "nthread": 1, **first.source.get("options", {})}
    kwargs |= {name: first.params[name] for name in first.source.get("params", ())}
    try:
        env = make(definition, **kwargs | changes)
    except (ValueError, TypeError, FileNotFoundError) as error:
        kind = FileNotFoundError if isinstance(error, FileNotFoundError) else ValueError
        raise kind(f"{path} cannot be shown: {error}") from error
    check_episode(env, first, path)
    return env


def check_episode(env: Env, episode: Trajectory, name: str | Path = "the episode") -> None:
    """Check that an environment accepts the states of an episode."""
    if episode.task != env.task.name:
        raise ValueError(f"{name} is an episode of the task {episode.task!r}, not of the task {env.task.name!r}")
    parts = {part: [place.start, place.stop] for part, place in env.state_space.parts.items()}
    if difference := _difference(episode.state_parts, parts):
        raise ValueError(
            f"{name} does not fit the current task {episode.task!r}, whose states have {difference}: the task or its "
            "model has changed, or options such as dynamics are missing"
        )


def _files(paths: Iterable[str | Path]) -> list[Path]:
    files: list[Path] = []
    for path in map(Path, paths):
        if not path.exists():
            raise FileNotFoundError(f"there is no file {path}")
        members = sorted(path.glob("*.npz")) if path.is_dir() else [path]
        if not members:
            raise FileNotFoundError(f"there is no episode in the folder {path}: it contains no .npz file")
        files += members
    return files


def _difference(first: Mapping[str, Sequence[int]], second: Mapping[str, Sequence[int]]) -> str:
    """Describe how a second state layout differs from the first, such as "qpos of 7 numbers, not 9", or return ""."""
    for name in {**first, **second}:
        sizes = [parts[name][1] - parts[name][0] if name in parts else None for parts in (first, second)]
        if sizes[0] != sizes[1]:
            return f"no {name}" if sizes[1] is None else f"{name} of {sizes[1]} numbers, not {sizes[0] or 0}"
    return "" if list(first.items()) == list(second.items()) else "their parts in another order"


def _task(path: Path, episode: Trajectory, task: str | Path | type[Task] | None) -> type[Task]:
    if task is not None:
        return find_task(task)
    spelled = episode.source.get("task", episode.task if "task" not in episode.source else None)
    advice = f"pass a file that defines the task of {path}"
    if spelled is None:
        raise ValueError(f"the task {episode.task!r} was defined in a notebook or a script: {advice}")
    file = spelled.partition(":")[0]
    if file.endswith(".py") and not Path(file).is_file():
        raise FileNotFoundError(f"the file of the task {episode.task!r}, {file}, does not exist any more: {advice}")
    if file.endswith(".py") and (reason := _foreign(Path(file).resolve())):
        raise ValueError(
            f"{path} names the task file {file}, which would be run as code, and {reason}: if you trust the file, "
            "pass it as "
            f"the task, with --task {spelled} or task={spelled!r}"
        )
    try:
        return find_task(spelled)
    except ValueError as error:
        if file.endswith(".py"):
            raise
        raise ValueError(f"{error}; {advice}") from error


def _foreign(file: Path) -> str:
    """Return why other users may have changed a file, such as "it can be written by other users", or ""."""
    for place, name in ((file, "it"), (file.parent, f"its folder {file.parent}")):
        status = place.stat()
        if status.st_uid not in (os.getuid(), 0):
            return f"{name} belongs to another user"
        if status.st_mode & stat.S_IWOTH or (status.st_mode & stat.S_IWGRP and not _is_private(status.st_gid)):
            return f"{name} can be written by other users"
    return ""


def _is_private(group: int) -> bool:
    if group == 0:
        return True
    try:
        user, entry = pwd.getpwuid(os.getuid()), grp.getgrgid(group)
    except KeyError:
        return False
    return user.pw_gid == group and entry.gr_name == user.pw_name and set(entry.gr_mem) <= {user.pw_name}
