"""Find and import modules from the folder of a task's file, as Python does for a script."""

import ast
import contextlib
import importlib.util
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

from lyceum_warp.binding.opened_files import Stamps, data_files, stamps

_taken: dict[str, Stamps] = {}
"""Maps each imported local module to the stamps of its file, and of the data files that it read, at its import."""


def local_modules(file: Path) -> dict[str, Path]:
    """Find the modules that a Python file imports from its own folder, directly or indirectly.

    No module is run. A package without ``__init__.py`` is returned as its folder.
    """
    folder = file.resolve().parent
    found: dict[str, Path] = {}
    pending = [("", file.resolve())]
    while pending:
        name, path = pending.pop()
        try:
            tree = ast.parse(path.read_bytes())
        except (OSError, SyntaxError, ValueError):
            continue
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        for wanted in _imported_names(tree, package):
            if _module_file(folder, wanted) is None:
                wanted = wanted.rpartition(".")[0]  # an imported name may be an attribute instead of a module
            for part in _prefixes(wanted):
                if part not in found and (module := _module_file(folder, part)) not in (None, file.resolve()):
                    found[part] = module
                    if module.is_file():
                        pending.append((part, module))
    return found


def _imported_names(tree: ast.AST, package: str) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            with contextlib.suppress(ImportError):  # a relative import with too many dots leads out of the package
                owner = importlib.util.resolve_name("." * node.level + (node.module or ""), package or None)
                yield from (owner, *(f"{owner}.{alias.name}" for alias in node.names))


def _prefixes(name: str) -> list[str]:
    parts = name.split(".") if name else []
    return [".".join(parts[: i + 1]) for i in range(len(parts))]


def _module_file(folder: Path, name: str) -> Path | None:
    """Return a module's file in a folder. A package without ``__init__.py`` is returned as its folder."""
    if not name:
        return None
    base = folder.joinpath(*name.split("."))
    for file in (base / "__init__.py", base.with_name(base.name + ".py")):
        if file.is_file():
            return file
    return base if base.is_dir() and any(base.glob("*.py")) else None


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
