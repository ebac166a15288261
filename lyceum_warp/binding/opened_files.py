"""Record the data files that a task's modules read when they are imported or bound to a model."""

import contextlib
import inspect
import os
import sys
import sysconfig
import weakref
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

Stamps: TypeAlias = dict[Path, tuple[int, int] | None]
"""The modification time and the size of each file."""

_READERS = frozenset(("<module>", "edit_model", "model", "obs"))
"""The code of a task's module that may read files: its top level, and the functions that ``BoundTask`` calls."""

_PACKAGES = {*map(sysconfig.get_path, ("stdlib", "platstdlib", "purelib", "platlib")), Path(__file__).parents[1]}
_NO_DATA = tuple(f"{folder}{os.sep}" for folder in (*_PACKAGES, "/proc", "/sys", "/dev"))
"""Folders of installed packages and of the kernel, whose files are no data of a task."""

_reads: "weakref.WeakKeyDictionary[ModuleType, Stamps]" = weakref.WeakKeyDictionary()


def stamps(files: Iterable[Path]) -> Stamps:
    """Read the modification times and sizes of files."""
    stamp_of: Stamps = dict.fromkeys(files)
    for file in stamp_of:
        with contextlib.suppress(OSError):
            stamp_of[file] = (stat := file.stat()).st_mtime_ns, stat.st_size
    return stamp_of


def data_files(sources: Iterable[Path]) -> Stamps:
    """Return the data files that Python files have read, with the stamps that the data had at that time.

    Paths that were relative to the working directory stay relative. Deleted files are left out.
    """
    files, data = {source.resolve() for source in sources}, Stamps()
    for module, reads in list(_reads.items()):
        file = Path(getattr(module, "__file__", None) or "")
        if file.resolve() not in files or sys.modules.get(module.__name__) is not module:
            continue
        for path, stamp in list(reads.items()):
            if path.is_relative_to(file.parent):  # the sources are named by resolved paths
                path = file.resolve().parent / path.relative_to(file.parent)
            if path.is_file():
                data[path] = stamp
    return data


def _record(event: str, arguments: tuple[Any, ...]) -> None:
    """Record a file that is opened for reading. Python calls this function at each audit event of the process."""
    if (
        event != "open"
        or not isinstance(arguments[0], str | bytes | os.PathLike)
        or arguments[2] & (os.O_WRONLY | os.O_RDWR)
    ):
        return
    frame = inspect.currentframe()
    while frame is not None and frame.f_code.co_name not in _READERS:
        frame = frame.f_back
    if frame is None or (name := frame.f_globals.get("__name__", "__main__")) == "__main__":
        return  # no module is being imported or bound
    module, path = sys.modules.get(name), os.path.normpath(os.fsdecode(arguments[0]))
    if isinstance(module, ModuleType) and not path.startswith(_NO_DATA) and not path.endswith((".py", ".pyc")):
        _reads.setdefault(module, {}).update(stamps([Path(path)]))


sys.addaudithook(_record)
