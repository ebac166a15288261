"""Find and import modules from the folder of a task's file, as Python does for a script."""

import contextlib
import importlib
import modulefinder
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from lyceum_warp.binding.opened_files import Stamps, data_files, stamps

_taken: dict[str, Stamps] = {}
"""Maps each imported local module to the stamps of its file, and of the data files that it read, at its import."""


class _Finder(modulefinder.ModuleFinder):
    """Finds modules in the folders of ``path``, including packages without ``__init__.py``."""

    def find_module(self, name: str, path: Any, parent: Any = None) -> tuple[Any, str, tuple[str, str, int]]:
        for folder in map(Path, self.path if path is None else path):
            if any((folder / name).glob("*.py")):
                return None, str(folder / name), ("", "", 5)  # modulefinder's number for a package
            if (file := folder / f"{name}.py").is_file():
                return file.open("rb"), str(file), (".py", "rb", 1)  # modulefinder's number for a source file
        raise ImportError(name)

    def load_package(self, name: str, folder: str) -> Any:
        if (Path(folder) / "__init__.py").is_file():
            return super().load_package(name, folder)
        package: Any = self.add_module(name)
        package.__file__, package.__path__ = folder, [folder]
        return package


def local_modules(file: Path) -> dict[str, Path]:
    """Find the modules that a Python file imports from its own folder, directly or indirectly.

    No module is run. A package without ``__init__.py`` is returned as its folder.
    """
    finder = _Finder([str(file.resolve().parent)])
    with contextlib.suppress(OSError, SyntaxError, ValueError):
        finder.run_script(str(file))
    modules: dict[str, Any] = finder.modules
    paths = {name: Path(module.__file__) for name, module in modules.items() if name != "__main__"}
    return {name: path for name, path in paths.items() if path != file.resolve()}


@contextlib.contextmanager
def importable(file: Path, modules: Mapping[str, Path]) -> Iterator[None]:
    """Let a task's file import the modules that ``local_modules`` has found in its folder.

    A loaded module of the same name is replaced if it has changed or comes from another folder. After an error,
    ``sys.modules`` is restored.
    """
    before = {name: sys.modules.get(name) for name in modules}
    if any(name in _taken and _taken[name] != stamps({path: None} | _taken[name]) for name, path in modules.items()):
        for name in modules:  # reload all of them, because they may have imported names from each other
            if name in _taken:
                sys.modules.pop(name, None)
    folder, bytecode = str(file.resolve().parent), sys.dont_write_bytecode
    sys.path.insert(0, folder)
    importlib.invalidate_caches()
    sys.dont_write_bytecode = True  # write no bytecode into run folders
    try:
        yield
    except BaseException:
        for name, module in before.items():
            sys.modules.pop(name, None)
            if module is not None:
                sys.modules[name] = module
        raise
    finally:
        sys.path.remove(folder)
        sys.dont_write_bytecode = bytecode
    for name, path in modules.items():
        if (module := sys.modules.get(name)) is not None and module is not before[name]:
            _taken[name] = stamps([path]) | data_files([path])
