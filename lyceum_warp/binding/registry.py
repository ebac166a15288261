"""Find tasks by name, by file or by class, and register users' tasks."""

import contextlib
import functools
import importlib
import importlib.util
import inspect
import io
import linecache
import os
import pkgutil
import re
import sys
import threading
import traceback
import weakref
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from lyceum_warp.binding.local_modules import importable, local_modules
from lyceum_warp.binding.opened_files import Stamps, data_files, stamps
from lyceum_warp.core.task import Task
from lyceum_warp.support.collection import without_collection
from lyceum_warp.support.interrupts import Interrupted
from lyceum_warp.support.suggestions import did_you_mean

_tasks: dict[str, type[Task]] = {}

_loaded: dict[str, Stamps] = {}
"""Maps the module of each task file to the stamps that its source and data files had when they were loaded."""

_LOADING = threading.RLock()
"""Held while a file is loaded, because imports and linecache are global to the process."""

_PACKAGE = "lyceum_warp.tasks."
_FILE = "lyceum_task_"

_sources: "weakref.WeakKeyDictionary[type[Task], Mapping[Path, bytes]]" = weakref.WeakKeyDictionary()


def register(task: type[Task]) -> type[Task]:
    """Class decorator: register a task. The task's name is the class name in snake_case.

    A class may replace an earlier class of the same name and file. This happens if a notebook runs a cell again.

    Raises:
        ValueError: The name belongs to another task, or the class is not a task.
    """
    candidate: Any = task
    if not (isinstance(candidate, type) and issubclass(candidate, Task)):
        name = getattr(candidate, "__name__", repr(candidate))
        raise ValueError(f"@lw.register takes a subclass of lw.Task, not {name}: write class {name}(lw.Task)")
    name = task_name(task)
    previous = _tasks.get(name)
    if previous is None and not task.__module__.startswith(_PACKAGE) and name in _package_modules():
        owner = _package_modules()[name]
    elif previous is not None and not _may_replace(task, previous):
        owner = f"{previous.__module__}.{previous.__qualname__}"
    else:
        _tasks[name] = task
        return task
    raise ValueError(f"the task name {name!r} is taken by {owner}: rename yours")


def _may_replace(task: type[Task], previous: type[Task]) -> bool:
    # two task files may have the same name
    by_path = task.__module__.startswith(_FILE) and previous.__module__.startswith(_FILE)
    return by_path or previous.__module__ == task.__module__ or _file(previous) == _file(task)


def package_task_names() -> list[str]:
    """Names of the tasks that come with the package."""
    return list(_package_modules())


@functools.cache
def _package_modules() -> dict[str, str]:
    """Find the modules of the package's tasks without importing them.

    A module directly in ``lyceum_warp.tasks`` has the name of its only task. A folder lists its tasks and their
    modules in ``TASKS``.
    """
    modules: dict[str, str] = {}
    for folder in map(Path, importlib.import_module("lyceum_warp.tasks").__path__):
        for module in pkgutil.iter_modules([str(folder)]):
            if module.ispkg:
                tasks = importlib.import_module(f"{_PACKAGE}{module.name}").TASKS
                modules |= {task: f"{_PACKAGE}{module.name}.{file}" for file, names in tasks.items() for task in names}
            else:
                modules[module.name] = f"{_PACKAGE}{module.name}"
    return modules


def _file(task: type[Any]) -> str | None:
    file = getattr(sys.modules.get(task.__module__), "__file__", None)
    return file and str(Path(file).resolve())


def spelled_task(task: type[Task]) -> str | None:
    """Return the name or ``file:Class`` by which ``find_task`` finds a task in another process.

    The result is None for a task without a file.
    """
    if task.__module__.startswith("lyceum_warp."):
        return task_name(task)
    file = _file(task)
    return f"{file}:{task.__name__}" if file and file.endswith(".py") and Path(file).is_file() else None


def task_name(task: type[Task]) -> str:
    """Return the name under which a task is registered: the class's name in snake_case.

    Some of the package's tasks have a prefix, such as ``dm/`` in ``dm/walker_walk``.
    """
    name = snake_case(task.__name__)
    declared = (full_name for full_name, module in _package_modules().items() if module == task.__module__)
    return next((full_name for full_name in declared if full_name.endswith(f"/{name}")), name)


def file_name(name: str) -> str:
    """Convert a task's name to a part of a file name: dm/walker_walk to dm-walker_walk."""
    return name.replace("/", "-")


def snake_case(name: str) -> str:
    """Convert the name of a class to a task name: HalfCheetah to half_cheetah."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def task_names() -> list[str]:
    """Names of all tasks, from the package and from the user."""
    return sorted({*_tasks, *package_task_names()})


def find_task(task: str | Path | type[Task]) -> type[Task]:
    """Find a task's class by name, by file (``path/to/file.py`` or ``path/to/file.py:Class``), or return a given class.

    A file may import modules from its folder. If one of these files has changed, the task's file is run again. Existing
    environments still use the old version.

    Raises:
        ValueError: There is no such task, or its file can't be run.
        FileNotFoundError: There is no such file.
    """
    if isinstance(task, type) and issubclass(task, Task):
        source_files(task)
        return task
    if isinstance(task, Path):
        task = str(task)
    if not isinstance(task, str):
        raise ValueError(f"a task is a name, a file or a subclass of lw.Task, not {task!r}")
    path, _, attribute = task.partition(":")
    if path.endswith(".py"):
        return _task_of_file(Path(path), attribute)
    if task not in _tasks and (module := _package_modules().get(task)) is not None:
        with without_collection():
            importlib.import_module(module)
    if task in _tasks:
        source_files(_tasks[task])
        return _tasks[task]
    hint = did_you_mean(task, task_names(), "lyceum-warp tasks lists them")
    raise ValueError(f"there is no task {task!r}: {hint} (a task of your own is given as path/to/file.py)")


@contextlib.contextmanager
def errors_of(task: type[Task]) -> Iterator[None]:
    """Put the task's name in front of the message of an error."""
    try:
        yield
    except (ValueError, FileNotFoundError) as error:
        error.args = (f"the task {task_name(task)!r}: {error}",)
        raise


def source_files(task: type[Task]) -> Mapping[Path, bytes]:
    """Return the source of a task's file and of the modules that it imports from its folder.

    The source is the one that was loaded, even if a file has changed since then. A class in a notebook has no file, so
    the result is empty.
    """
    if task not in _sources:
        file = Path(_file(task) or "")
        _sources[task] = _read(file, local_modules(file)) if file.suffix == ".py" and file.is_file() else {}
    return _sources[task]


def _read(file: Path, modules: Mapping[str, Path]) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in (file.resolve(), *modules.values()) if path.is_file()}


def _run(path: Path, name: str, source: bytes) -> None:
    """Run a file's source as a module, and replace the previous module of the same name."""
    module = ModuleType(name)
    module.__file__ = file = str(path.resolve())
    before = sys.modules.get(name)
    sys.modules[name] = module
    try:
        code = compile(source, file, "exec")  # cached bytecode with the same time stamp may be stale
        # Warp reads the source of functions from linecache: store the text that runs, because the file may change
        text = importlib.util.decode_source(source)
        linecache.cache[file] = (len(text), None, list(io.StringIO(text)), file)
        exec(code, vars(module))
    except BaseException as error:
        del sys.modules[name]
        if before is not None:
            sys.modules[name] = before
        if isinstance(error, Interrupted | KeyboardInterrupt):
            raise
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        line = error.lineno if isinstance(error, SyntaxError) else lines[-1] if lines else None
        where = f"the file {path}" if line is None else f"the file {path}, line {line}"
        if isinstance(error, ImportError):
            raise ImportError(
                f"{where}: {error}: install the missing module, or put it into the same folder"
            ) from error
        raise ValueError(f"{where}: {_explained(error)}") from error
    finally:
        linecache.cache.pop(file, None)


def _explained(error: BaseException) -> str:
    """Return the message for an error in a task file, with a fix if Warp's own message is unclear."""
    text = str(error).strip()
    if match := re.search(r"argument '(\w+)' of function (\w+): Unrecognized type '<class '[\w.]*?(\w+)'>'", text):
        argument, function, kind = match.groups()
        return f"the argument {argument} of {function} has the type {kind}, which must be decorated with @wp.struct"
    if match := re.search(r"type object '(\w+)' has no attribute '_type_'", text):
        return (
            f"a @wp.struct has a field of the type {match.group(1)}: it can hold float, int, bool, vectors and "
            "matrices (wp.vec3, ...) and arrays"
        )
    return text if type(error) is ValueError else f"{type(error).__name__}: {text}".removesuffix(": ")


def _task_of_file(path: Path, attribute: str) -> type[Task]:
    with _LOADING:
        module = _module_of_file(path)
    tasks = {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Task) and value.__module__ == module.__name__
    }
    if attribute:
        if attribute not in tasks:
            raise ValueError(f"{path} has no task {attribute!r}; it has {', '.join(tasks) or 'none'}")
        return tasks[attribute]
    if len(tasks) != 1:
        raise ValueError(f"{path} has {len(tasks)} tasks ({', '.join(tasks)}): name one of them, as {path}:Name")
    return next(iter(tasks.values()))


def class_in_file(spelled: str, base: type[Any]) -> type[Any]:
    """Load a subclass of ``base`` from ``path/to/file.py:Class``.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file cannot be run, or has no such class.
    """
    cls = object_in_file(spelled)
    if not isinstance(cls, type) or not issubclass(cls, base):
        raise ValueError(f"{spelled} is not a subclass of {base.__name__}")
    return cls


def made(kind: type[Any], *arguments: Any, **options: Any) -> Any:
    """Make an object of a user's class.

    Raises:
        ValueError: The class takes other arguments.
    """
    try:
        inspect.signature(kind).bind(*arguments, **options)
    except TypeError as error:
        raise ValueError(f"{kind.__name__} takes other arguments: {error}") from error
    return kind(*arguments, **options)


def class_sources(kind: type[Any]) -> dict[str, bytes]:
    """Read the file of a class that ``class_in_file`` has loaded, and the modules that it imports from its folder.

    The keys are paths in this folder. The class's file is the first. The result is empty for any other class.
    """
    if not kind.__module__.startswith(_FILE):
        return {}
    file = Path(_file(kind) or "")
    sources = _read(file, local_modules(file))
    return {path.relative_to(file.parent).as_posix(): content for path, content in sources.items()}


def object_in_file(spelled: str) -> Any:
    """Load a class or a function from ``path/to/file.py:name``.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file cannot be run, or has no such name.
    """
    file, _, name = spelled.rpartition(":")
    with _LOADING:
        module = _module_of_file(Path(file))
    if name not in vars(module):
        raise ValueError(f"{file} has no {name!r}: write path/to/file.py:name")
    return vars(module)[name]


def kernel_name(task: type[Task]) -> str:
    """Return the task's name in Warp's cache. It contains a hash of the file, so copies of a file share kernels."""
    module = task.__module__
    if module.startswith(_FILE) and task in _sources:
        module = f"{module[:-8]}{zlib.crc32(b''.join(_sources[task].values())):08x}"
    return f"{module}.{task.__qualname__}"


def _module_of_file(path: Path) -> ModuleType:
    """Return the module of a task's file. Run the file again if it or one of its local modules has changed."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {str(path)!r}")
    name = f"{_FILE}{path.stem}_{zlib.crc32(os.fsencode(path.resolve())):08x}"
    if name not in sys.modules or name not in _loaded or _loaded[name] != stamps(_loaded[name]):
        modules = local_modules(path)
        read, sources = stamps([path.resolve(), *modules.values()]), _read(path, modules)
        with importable(path, modules):
            _run(path, name, sources[path.resolve()])
        _loaded[name] = read | data_files(sources)
        for value in vars(sys.modules[name]).values():
            if isinstance(value, type) and issubclass(value, Task) and value.__module__ == name:
                _sources[value] = sources
    return sys.modules[name]
