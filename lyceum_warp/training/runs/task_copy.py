"""Copy a run's task into the run's folder, and later choose between the copy and the original."""

import filecmp
import hashlib
import io
import logging
import os
import warnings
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.binding import data_files, package_task_names, source_files, stamps
from lyceum_warp.core import EnvOptions, ModelFile, Task, find_model, read_spec
from lyceum_warp.env import Env
from lyceum_warp.training.runs.folder import Run
from lyceum_warp.training.runs.trust import is_trusted, remember

log = logging.getLogger(__name__)

Files = dict[Path, Path | bytes]
"""Maps the path of each new file to its content, or to an existing file to copy."""

TABLES, FIT = "tables", "fit"
_APART = 2
"""If the task's file lies more than this number of levels below the folder that contains both the task and the model,
the two are copied into separate folders."""
_LARGEST = 512 * 2**20
"""Maximum size of a model, and of all data files, that are copied, in bytes."""


def task_copy(env: Env) -> tuple[dict[str, Any], dict[str, Path | bytes]]:
    """Collect the files of an environment's task for the folder of a run. Files of the package are not included.

    Returns:
        The entry ``kept`` of config.json, and the files of the folder ``task``, by their paths in this folder.
    """
    task, model_given = env.task.definition, env.options.model is not None
    sources, private = source_files(task), not task.__module__.startswith("lyceum_warp.")
    file = next(iter(sources), None)
    manifest: dict[str, Any] = {"name": env.task.name, "model_hash": _model_hash(env), "model_given": model_given}
    code: Files = {}
    model: Files = {}
    model_file = None
    if private:
        code = {**sources, **{path: path for path in _data_files(task)[0]}}
    if private or model_given:
        model_file, model = _model_files(env)
    # relative paths stay the same, so that the copied task finds the copied model
    names = _names_in_copy([*code, *model])
    if names.get(file, "").count("/") > _APART:
        names = _names_in_copy(code) | {path: f"model/{name}" for path, name in _names_in_copy(model).items()}
    files = {names[path]: content for path, content in {**code, **model}.items()}
    if file is not None:
        manifest["source_hash"] = _digest(sources[file])
        if private:
            modules = {path.relative_to(file.parent).as_posix(): _digest(code[path]) for path in code if path != file}
            manifest |= {"file": names[file], "modules": modules, "program": task.__module__ == "__main__"}
    if model_file is not None:
        manifest["model"] = names[model_file]
    if env.task.fit is not None:
        files |= {f"{FIT}/{name}": env.task.fit.folder / name for name in ("fit.json", "draws.npz")}
    for name, value in env.given_params.items():
        if (table := _table(value)) is not None:
            files[f"{TABLES}/{name}.npy"] = table if isinstance(table, Path) else _npy(table)
            rows = getattr(value, "names", None) or [None]  # those of lw.Clips; a torch.Tensor's may be None
            if all(isinstance(row, str) for row in rows):
                files[f"{TABLES}/{name}.txt"] = "\n".join(rows).encode()
    return manifest, files


def _data_files(task: type[Task]) -> tuple[list[Path], list[Path]]:
    """List the data files that a task reads: those that a run can copy, and all others.

    The copy of the task's file finds only files below its own folder.
    """
    sources = source_files(task)
    folder, data = next((file.parent for file in sources), Path()), data_files(sources)
    if (objects := task.objects) is not None:  # MuJoCo reads meshes without Python
        geoms = [geom for geoms in objects.models.values() for geom in geoms if not isinstance(geom.file, ModelFile)]
        data |= stamps(path for geom in geoms if (path := objects.path(geom, task)))
    small = sum(path.stat().st_size for path in data) <= _LARGEST
    copies = [path for path, stamp in data.items() if folder in path.parents and stamps([path]) == {path: stamp}]
    copies = copies if small else []
    return copies, [path for path in data if path not in copies]


def note_uncopied_data(env: Env) -> None:
    """Log a warning if the run's copy of an environment's task lacks data files that the task reads."""
    for path in _data_files(env.task.definition)[1][:1]:
        log.warning(
            "the run has no copy of %s, which the task %r reads: it copies files that lie below the folder of the "
            "task's file, have not changed since they were read, and have less than %d MiB",
            path, env.task.name, _LARGEST // 2**20,
        )  # fmt: skip


def _names_in_copy(paths: Collection[Path]) -> dict[Path | None, str]:
    root = os.path.commonpath([path.parent for path in paths]) if paths else ""
    return {path: path.relative_to(root).as_posix() for path in paths}


def json_value(name: str, value: Any) -> Any:
    """Convert a task parameter to a JSON value for config.json."""
    if isinstance(value, bool | int | float) or (isinstance(value, str) and not is_table(value)):
        return value
    table = _table(value)
    if isinstance(table, Path):
        return str(table.absolute())
    return _array(value).tolist() if table is None else f"{name}.npy"


def _array(value: Any) -> np.ndarray:
    return np.asarray(value.cpu() if hasattr(value, "cpu") else value)


def _table(value: Any) -> Path | np.ndarray | None:
    """Get the file or the array of a table parameter. Return None for other parameters."""
    if is_table(value):
        return Path(value)
    array = _array(value)
    return array if array.dtype.kind in "fiu" and array.size > 64 else None


def is_table(value: Any) -> bool:
    """Check whether a parameter is the path of a ``.npy`` file."""
    return isinstance(value, str | Path) and str(value).endswith(".npy")


def table_copies(run: Run) -> dict[str, Path]:
    """Return the run's copies of those tables that had no file, or whose files are missing or have changed."""
    tables = {name: value for name, value in run.config["params"].items() if is_table(value)}
    copies = {name: (run.task_folder / TABLES / f"{name}.npy").absolute() for name in tables}
    return {
        name: copy
        for name, copy in copies.items()
        if copy.is_file() and not (_has_file(tables[name]) and filecmp.cmp(tables[name], copy, shallow=False))
    }


def table_rows(run: Run, table: str) -> list[str]:
    """Return the names of the rows of a run's table, such as those of its clips. The list is empty if it has none."""
    file = run.task_folder / TABLES / f"{table}.txt"
    return file.read_text().splitlines() if file.is_file() else []


def _has_file(table: str) -> bool:
    return Path(table).is_absolute() and Path(table).is_file()  # an array's name is no path


def fit_copy(run: Run) -> dict[str, str]:
    """Return the option ``fitted`` with the run's copy of its fit, if the run used one."""
    folder = run.task_folder / FIT
    return {"fitted": str(folder.absolute())} if (folder / "fit.json").is_file() else {}


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def run_env(
    run: Run,
    options: EnvOptions,
    params: Mapping[str, Any],
    *,
    task: str | None = None,
    trust: bool = False,
) -> Env:
    """Make an environment for a run's task, or for another given task.

    If a file or a model has been moved or changed since the run started, the run's copy is used, and a warning is
    logged. Tasks of the package are used in their current version. The run's code is executed only if this user has
    run it on this machine before, if ``task`` names it, or with ``trust``.

    Raises:
        ValueError: The task does not fit the run, or the run's code is not trusted.
        FileNotFoundError: The task or its model is missing, and the run has no copy.
    """
    manifest = run.manifest
    file = (run.task_folder / manifest.get("file", "")).resolve()
    if task is None:
        task = _run_task(run, trust=trust)
    elif Path(task.partition(":")[0]).resolve() == file:
        remember(run.folder, run.config)
    else:
        return Env(task, options, params)
    copy = run.task_folder / manifest.get("model", "")
    if not copy.is_file():
        return Env(task, options, params)
    if not manifest.get("model_given") or isinstance(options.model, str):
        reason = "has changed since the run began"
        try:
            env = Env(task, options, params)
            if not _model_changed(run, env):
                return env
        except FileNotFoundError:
            reason = "is no longer where it was"
        log.warning("the model of the task %r %s: the run's own copy is used, %s", run.task_name, reason, copy)
    return Env(task, options.changed({"model": read_spec(copy)}), params)


def _run_task(run: Run, *, trust: bool) -> str:
    """Return the name of a run's task, its file, or the run's copy of the file if the file has moved or changed."""
    manifest, task = run.manifest, run.config["task"]
    if task is None or manifest.get("program"):
        program = "a notebook" if task is None else task.partition(":")[0]
        raise ValueError(
            f"the run in {run.folder} was started by {program}, which also defines its task {run.task_name!r}: pass a "
            "file that only defines the task (eval --task my_task.py, train my_task.py --from), or resume the run in "
            "that program (lw.train(learner, lw.Run.open(folder), iterations))"
        )
    path, colon, attribute = task.partition(":")
    if path in package_task_names():
        return str(task)
    copy = run.task_folder / manifest.get("file", "")
    code = f"{copy if copy.is_file() else path}{colon}{attribute}"
    if not (trust or is_trusted(run.folder, run.config)):
        raise ValueError(
            f"{run.folder / 'config.json'} names the task {task}, whose code you have not run on this machine: read "
            f"{code}, and then name it as the task (eval --task {code}, train {code} --resume {run.folder})"
        )
    if not copy.is_file() or not (changes := _source_changes(Path(path), manifest)):
        return str(task)
    new = f"; give {path} as the task to use the new version" if Path(path).is_file() else ""
    log.warning("%s: the run's own copy is used, %s%s", changes[0], copy, new)
    return f"{copy}{colon}{attribute}"


def _source_changes(file: Path, manifest: Mapping[str, Any], sources: Mapping[Path, bytes] | None = None) -> list[str]:
    """Describe the changes of a task's file and of the files that it uses since a run began.

    ``sources`` has the code that was loaded, which may have changed since then.
    """
    changes = []
    for name, digest in {file.name: manifest.get("source_hash"), **manifest.get("modules", {})}.items():
        path = file.parent / name
        content = (sources or {}).get(path)
        if content is None and not path.is_file():
            changes.append(f"{path} does not exist any more")
        elif digest not in (None, _digest(path if content is None else content)):
            changes.append(f"{path} has changed since the run began")
    return changes


def note_changes(run: Run, env: Env, *, model: bool = True) -> None:
    """Log a warning if an environment's task or its compiled model differs from the run's.

    The compiled model depends on the physics. Set ``model`` to False if the physics differ on purpose.
    """
    manifest, sources = run.manifest, source_files(env.task.definition)
    file = next(iter(sources), None)
    if manifest.get("program"):  # a change of the training script may have nothing to do with the task
        manifest = {**manifest, "source_hash": None}
    for change in _source_changes(file, manifest, sources) if file is not None else ():
        log.warning("%s", f"{change}: the new version is used" if "changed" in change else change)
    for name, copy in table_copies(run).items():
        table = run.config["params"][name]
        texts = {str(copy): f"the run's own copy is used, {copy}", table: "the new version is used"}
        text = texts.get(str(json_value(name, env.given_params.get(name))))
        if text is not None and _has_file(table):
            log.warning("%s has changed since the run began: %s", table, text)
    if model and _model_changed(run, env):
        log.warning("the model of the task %r has changed since the run began: the new version is used", env.task.name)


def _model_changed(run: Run, env: Env) -> bool:
    """Check whether the model has changed since the run started.

    With another version of MuJoCo, the result is False, because a new version may compile the model differently.
    """
    digest, version = run.manifest.get("model_hash"), mujoco.__version__
    same_version = run.config.get("versions", {}).get("mujoco", version) == version
    return same_version and digest not in (None, _model_hash(env))


def _digest(content: bytes | Path) -> str:
    with io.BytesIO(content) if isinstance(content, bytes) else content.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def _model_hash(env: Env) -> str:
    """Hash the compiled model, except for fields with paths."""
    digest = hashlib.sha256()
    for owner in (env.task.model, env.task.model.opt):
        for name in sorted(dir(owner)):
            if name.startswith("_") or name.endswith("pathadr") or name in ("paths", "npaths", "nbuffer"):
                continue
            value = getattr(owner, name)
            if isinstance(value, np.ndarray):
                digest.update(name.encode() + np.ascontiguousarray(value).tobytes())
            elif isinstance(value, bytes | int | float):
                digest.update(f"{name}{value!r}".encode())
    return digest.hexdigest()[:16]


def _model_files(env: Env) -> tuple[Path | None, Files]:
    """Get the main file and all files of a task's model. A model made in Python is written as MJCF."""
    task, model = env.task.definition, env.options.model
    source = task.model if model is None else model
    if isinstance(source, str | Path):
        source = find_model(source, task if model is None else None)
    if isinstance(source, ModelFile):
        source = source.path()
    if isinstance(source, Path):
        source = source.resolve()
        files: Files = {path: path for path in (source, *_dependencies(source))}
    else:
        spec = env.task.spec.copy()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # logged when the environment was made
                spec.compile()
                text = spec.to_xml()
        except (ValueError, mujoco.FatalError):  # the model cannot be written as MJCF
            return None, {}
        folder = Path(spec.modelfiledir or ".").resolve()
        source = folder / "model.xml"
        files = {source: text.encode(), **{path: path for path in _spec_dependencies(spec, folder)}}
        for name, content in env.task.spec.assets.items():
            files.setdefault(folder / name, content)
    if sum(path.stat().st_size for path in files.values() if isinstance(path, Path)) > _LARGEST:
        return None, {}
    return source, files


def _dependencies(source: Path) -> list[Path]:
    """List the files to which a model file refers: includes, other models, meshes, textures, height fields."""
    if source.suffix.lower() == ".urdf":  # MuJoCo lists no dependencies of URDF files
        return _spec_dependencies(read_spec(source), source.parent)
    return [path for name in mujoco.mju_getXMLDependencies(str(source)) if (path := Path(name)) != source]


def _spec_dependencies(spec: mujoco.MjSpec, folder: Path) -> list[Path]:
    assets = (*spec.meshes, *spec.hfields, *spec.skins)
    names = [Path(spec.meshdir, asset.file) for asset in assets if asset.file]
    for texture in spec.textures:
        names += [Path(spec.texturedir, name) for name in (texture.file, *texture.cubefiles) if name]
    paths = dict.fromkeys(Path(os.path.normpath(folder / name)) for name in names)
    return [path for path in paths if path.is_file()]
