"""Load the public names of the package and of its rooms at their first use (PEP 562)."""

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lyceum_warp.support.collection import without_collection


def face(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package whose names are listed in its ``__init__.pyi``.

    Type checkers read the same file. It has lines such as ``from package.module import name as name``, and, for a
    submodule, ``from .folder import module as module``.
    """
    module, names = sys.modules[package], sources(package)

    def load(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        source, attribute = names[name]
        with without_collection():
            value = importlib.import_module(source)
        if attribute is not None:
            value = getattr(value, attribute)
        setattr(module, name, value)
        return value

    return load, lambda: sorted({*vars(module), *names}), sorted(names)


def sources(package: str) -> dict[str, tuple[str, str | None]]:
    """Return the module of each public name, and the name's attribute there, or None if the name is the module."""
    found: dict[str, tuple[str, str | None]] = {}
    file = Path(str(importlib.import_module(package).__file__)).with_suffix(".pyi")
    for node in ast.parse(file.read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.level:
            folder = ".".join(filter(None, (package, node.module)))
            found |= {alias.name: (f"{folder}.{alias.name}", None) for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {alias.name: (node.module, alias.name) for alias in node.names}
    return found
