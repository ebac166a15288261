"""A run's copies of its task and its model, and whether a later command uses them."""

import dataclasses
import hashlib
import itertools
import json
import logging
import os
import shutil
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.binding.models import find_model
from lyceum_warp.binding.registry import find_task, source_files
from lyceum_warp.env import Env
from lyceum_warp.model_files import ModelFile, read_spec
from lyceum_warp.options import EnvOptions
from lyceum_warp.runs import Run

log = logging.getLogger(__name__)

Note = Callable[[str], None]

_MODEL, _TABLES = "model", "tables"
_APART = 2
"""A task's file lies at most this many folders below the common one of it and its model."""
_LARGEST = 512 * 2**20
"""Models with larger files than this, in bytes, are not copied."""
_MOST_MODULES, _LARGEST_MODULES = 100, 8 * 2**20
"""Modules that a task imports from its folder are not copied if they are more, or larger in bytes."""


@dataclasses.dataclass(frozen=True)
class KeptTask:
    """What a run's folder keeps of its task.

    The file and the model of a task of the package are not copied: the release, which versions.json holds, has them.
    """

    config: dict[str, Any]
    """Entries of config.json."""
    files: dict[str, Path | bytes | np.ndarray]
    """What the folder ``task`` will hold, by path."""

    @classmethod
    def of(cls, env: Env) -> "KeptTask":
        """What to keep of an environment's task."""
        task = env.task.task
        loaded, own = source_files(task), not task.__module__.startswith("lyceum_warp.")
        file = next(iter(loaded), None)
        kept: dict[str, Any] = {"name": env.task.name, "model_hash": _model_hash(env)}
        files: dict[str, Path | bytes | np.ndarray] = {}
        if file is not None:
            kept["source_hash"] = _digest(loaded[file])
        sources: dict[Path, Path | bytes] = {}
        modules: list[Path] = []
        if own and file is not None:
            modules = _module_files(file, loaded)
            sources = {path: loaded[path] for path in (file, *modules)}
            kept["modules"] = {_beside(path, file): _digest(loaded[path]) for path in modules}
        main = None
        if own or env.options.model is not None:
            main, model = _model_files(env)
            sources |= model
        names = _names_in_copy(sources, file, modules)
        if own and file is not None:
            kept["file"], kept["program"] = names[file], task.__module__ == "__main__"
        if main is not None:
            kept["model"] = names[main]
        files |= {names[path]: content for path, content in sources.items()}
        kept["model_given"] = env.options.model is not None
        for name, value in env.given_params.items():
            if (table := _table(value)) is not None:
                files[f"{_TABLES}/{name}.npy"] = table
        return cls({"kept": kept}, files)

    def write(self, run: Run) -> None:
        """Write the files into a run's folder."""
        for name, content in self.files.items():
            path = run.task_folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(content, bytes):
                path.write_bytes(content)
            elif isinstance(content, np.ndarray):
                np.save(path, content)
            else:
                shutil.copyfile(content, path)


def given_params(env: Env) -> dict[str, Any]:
    """The parameters that an environment was made with, as config.json holds them."""
    return {name: _plain(name, value) for name, value in env.given_params.items()}


def _plain(name: str, value: Any) -> Any:
    if (table := _table(value)) is not None:
        return str(value) if isinstance(value, str | Path) else f"{name}.npy" if table.size else []
    if isinstance(value, bool | int | float | str):
        return value
    return np.asarray(value.cpu() if hasattr(value, "cpu") else value).tolist()


def _table(value: Any) -> Any:
    """The file or the array of a table, and None for other parameters."""
    if isinstance(value, str | Path) and str(value).endswith(".npy"):
        return Path(value)
    array = np.asarray(value.cpu() if hasattr(value, "cpu") else value)
    return array if array.dtype.kind in "fiu" and array.size > 64 else None


# what a later command uses


def run_env(
    run: Run, options: EnvOptions, params: Mapping[str, Any], *, note: Note = log.warning, task: str | None = None
) -> Env:
    """Make an environment of a run's task.

    A file or a model that has moved or changed since the run began is replaced by the run's own copy, and ``note`` gets
    a line that says so. A task of the package is taken as it is now.

    Args:
        run: The run.
        options: Options of the environment.
        params: Parameters of the task.
        note: Called with each line.
        task: Another task, which is taken as it is.

    Raises:
        ValueError: The task does not fit.
        FileNotFoundError: The task or its model is missing, and the run has no copy.
    """
    if task is not None:
        return Env(task, options, **params)
    kept = run.config.get("kept", {})
    chosen = run_task(run, note=note)
    params = run_params(run, params)
    copy = run.task_folder / kept["model"] if "model" in kept else None
    if copy is None or not copy.is_file():
        env = Env(chosen, options, **params)
        if _model_changed(run, kept, env):
            note(f"the model of the task {env.task.name!r} has changed since the run began")
        return env
    if kept["model_given"] and not isinstance(options.model, str):
        return Env(chosen, options.changed({"model": read_spec(copy)}), **params)
    try:
        env = Env(chosen, options, **params)
        if not _model_changed(run, kept, env):
            return env
        reason = "has changed since the run began"
    except FileNotFoundError:
        reason = "is no longer where it was"
    note(f"the model of the task {kept['name']!r} {reason}: the run's own copy is used, {copy}")
    return Env(chosen, options.changed({"model": read_spec(copy)}), **params)


def run_task(run: Run, *, note: Note = log.warning) -> str:
    """The task, by name or file, that stands for a run's; see ``run_env``.

    Args:
        run: The run.
        note: Called with each line.

    Raises:
        ValueError: The task was defined in a program or a notebook.
    """
    task, kept = run.config["task"], run.config.get("kept", {})
    if task is None or kept.get("program"):
        where = "a notebook" if task is None else task.partition(":")[0]
        raise ValueError(
            f"the task {kept['name']!r} of the run in {run.folder} was defined in {where}, which trained it: give a "
            "file that only defines it (eval --task my_task.py, train my_task.py --from), or go on there (resume=True)"
        )
    path, colon, attribute = task.partition(":")
    if not path.endswith(".py"):
        content = next(iter(source_files(find_task(task)).values()), None)
        if content is not None and kept.get("source_hash") not in (None, _digest(content)):
            note(f"the task {task!r} has changed since the run began: it is used as it is now")
        return task
    copy = run.task_folder / kept["file"] if "file" in kept else None
    if copy is None or not copy.is_file():
        return task
    changes = _source_changes(Path(path), kept)
    if not changes:
        return task
    new = f"; give {path} as the task to use the new version" if Path(path).is_file() else ""
    note(f"{changes[0]}: the run's own copy is used, {copy}{new}")
    return f"{copy}{colon}{attribute}"


def _source_changes(file: Path, kept: Mapping[str, Any], loaded: Mapping[Path, bytes] | None = None) -> list[str]:
    """What has happened to a task's file, and to the modules beside it, since the run began.

    Args:
        file: The task's file.
        kept: What config.json says about it.
        loaded: The files as they were loaded; by default, and for others, as they are now.
    """
    known = {file: kept.get("source_hash")} | {file.parent / name: h for name, h in kept.get("modules", {}).items()}
    changes = []
    for path, hashed in known.items():
        content = (loaded or {}).get(path)
        if content is None and not path.is_file():
            changes.append(f"{path} does not exist any more")
        elif hashed not in (None, _digest(path.read_bytes() if content is None else content)):
            changes.append(f"{path} has changed since the run began")
    return changes


def note_changes(run: Run, env: Env, *, note: Note = log.warning) -> None:
    """Note where an environment's task or its model is another than the run's; both are used as they are.

    Args:
        run: The run.
        env: The environment.
        note: Called with each line.
    """
    kept, loaded = run.config.get("kept", {}), source_files(env.task.task)
    file = next(iter(loaded), None)
    hashed = None if kept.get("program") else kept.get("source_hash")  # a program that trains changes on its own
    for change in _source_changes(file, {**kept, "source_hash": hashed}, loaded) if file is not None else ():
        note(f"{change}: it is used as it is now" if "changed" in change else change)
    if _model_changed(run, kept, env):
        note(f"the model of the task {env.task.name!r} has changed since the run began: it is used as it is now")


def run_params(run: Run, params: Mapping[str, Any]) -> dict[str, Any]:
    """Parameters of a run's task; a table that is not where it was is the run's own copy."""
    return {name: _found_table(run, name, value) for name, value in params.items()}


def _found_table(run: Run, name: str, value: Any) -> Any:
    """A parameter, with the run's copy of a table that is not where it was."""
    copy = run.task_folder / _TABLES / f"{name}.npy"
    if isinstance(value, str) and value.endswith(".npy") and not Path(value).is_file() and copy.is_file():
        return str(copy)
    return value


def _model_changed(run: Run, kept: Mapping[str, Any], env: Env) -> bool:
    """Whether the model differs from the one that the run began with; False where MuJoCo is another version."""
    try:
        version = json.loads((run.folder / "versions.json").read_text())["mujoco"]
    except (OSError, ValueError, KeyError):
        return False
    return version == mujoco.__version__ and kept.get("model_hash") not in (None, _model_hash(env))


# copies


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _model_hash(env: Env) -> str:
    """A hash of the compiled model, the same in every process and wherever its files lie."""
    found = hashlib.sha256()
    for owner in (env.task.model, env.task.model.opt):
        for name in sorted(dir(owner)):
            if name.startswith("_") or name.endswith("pathadr") or name in ("paths", "npaths", "nbuffer"):
                continue
            value = getattr(owner, name)
            if isinstance(value, np.ndarray):
                found.update(name.encode() + np.ascontiguousarray(value).tobytes())
            elif isinstance(value, bytes | int | float):
                found.update(f"{name}{value!r}".encode())
    return found.hexdigest()[:16]


def _module_files(file: Path, loaded: Mapping[Path, bytes]) -> list[Path]:
    """The modules beside a task's file that it imports; none if they are too many or too large to copy."""
    found = [path for path in loaded if path != file]
    if len(found) > _MOST_MODULES or sum(len(loaded[path]) for path in found) > _LARGEST_MODULES:
        log.info("%s imports %d modules from its folder, too many or too large to copy into the run", file, len(found))
        return []
    return found


def _beside(path: Path, file: Path) -> str:
    """The path of a module relative to the folder of a task's file."""
    return path.relative_to(file.parent).as_posix()


def _names_in_copy(paths: Iterable[Path], file: Path | None, modules: Sequence[Path] = ()) -> dict[Path, str]:
    """The paths in the folder ``task`` of a task's file, of the modules beside it, and of its model's files.

    The files keep their places relative to each other, so that the copy of the task finds the copy of its model. Where
    the task's file lies elsewhere than its model, each has a place of its own.
    """
    paths = list(paths)
    if not paths:
        return {}
    root = Path(os.path.commonpath([path.parent for path in paths]))
    if file in paths and len(file.parent.relative_to(root).parts) > _APART:
        own = {path: _beside(path, file) for path in (file, *modules)}
        rest = _names_in_copy([path for path in paths if path not in own], None)
        return own | {path: f"{_MODEL}/{name}" for path, name in rest.items()}
    return {path: path.relative_to(root).as_posix() for path in paths}


def _model_files(env: Env) -> tuple[Path | None, dict[Path, Path | bytes]]:
    """The main file of a task's model, and all its files with their contents or the paths to copy.

    A model that was made in Python is written as MJCF, with the files that it names.
    """
    task, given = env.task.task, env.options.model
    source = given if given is not None else task.model
    if isinstance(source, str | Path):
        source = find_model(source, None if given is not None else task)
    if isinstance(source, ModelFile):
        source = source.path()
    text = None
    if not isinstance(source, Path):
        spec = env.task.spec.copy()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # they were logged when the environment was made
                spec.compile()
                text = spec.to_xml()
        except (ValueError, mujoco.FatalError) as error:
            log.info("the model of %s cannot be written as MJCF, so the run has no copy of it: %s", task, error)
            return None, {}
        source = Path(spec.modelfiledir or ".").absolute() / "model.xml"
    source = source.resolve()
    found = [source, *_named_files(source, text)]
    if sum(path.stat().st_size for path in found if path.is_file()) > _LARGEST:
        log.info("the model of %s is larger than %d MiB, so the run has no copy of it", task, _LARGEST // 2**20)
        return None, {}
    files: dict[Path, Path | bytes] = {path: path for path in found}
    if text is not None:
        files[source] = text.encode()
        for name, content in env.task.spec.assets.items():
            files.setdefault(source.parent / name, content)
    return source, files


def _named_files(source: Path, text: str | None = None) -> list[Path]:
    """The files that a model file names: included files, other models, meshes, textures, height fields."""
    found: dict[Path, None] = {}
    pending = [(source, text)]
    while pending:
        path, content = pending.pop()
        try:
            root = ET.fromstring(path.read_bytes() if content is None else content)
        except (ET.ParseError, OSError):
            continue
        folders = {path.parent, source.parent}
        for compiler in root.iter("compiler"):
            names = [compiler.get(name) for name in ("assetdir", "meshdir", "texturedir")]
            folders |= {base / name for base, name in itertools.product(tuple(folders), filter(None, names))}
        for file in _names(root):
            for folder, name in itertools.product(sorted(folders), (file, Path(file).name)):
                other = Path(os.path.normpath(folder / name))
                if other.is_file() and other not in found and other != source:
                    found[other] = None
                    if other.suffix.lower() in (".xml", ".mjcf", ".urdf"):
                        pending.append((other, None))
    return list(found)


def _names(root: ET.Element) -> Iterator[str]:
    for element in root.iter():
        for attribute, value in element.attrib.items():
            if attribute.startswith("file") and value:
                yield value.removeprefix("package://")
