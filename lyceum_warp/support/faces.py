"""Load the public names of the package and of its rooms at their first use (PEP 562)."""

import ast
import importlib
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from lyceum_warp.support.collection import without_collection
from lyceum_warp.support.docstrings import document_attributes

_documented: set[str] = set()
"""Modules whose classes list their attributes in ``help()``."""


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
        _document({source for source, _ in names.values()} & sys.modules.keys() - _documented)
        if attribute is not None:
            value = getattr(value, attribute)
        setattr(module, name, value)
        return value

    return load, lambda: sorted({*vars(module), *names}), sorted(names)


def _document(modules: Iterable[str]) -> None:
    """Let ``help()`` list the attributes of the modules' classes, also of those that no public name refers to."""
    for name in modules:
        _documented.add(name)
        for value in list(vars(sys.modules[name]).values()):
            if isinstance(value, type) and value.__module__ == name:
                document_attributes(value)


def sources(package: str) -> dict[str, tuple[str, str | None]]:
    """Return the module of each public name, and the name's attribute there, or None if the name is the module."""
    modules: dict[str, tuple[str, str | None]] = {}
    file = Path(str(importlib.import_module(package).__file__)).with_suffix(".pyi")
    for node in ast.parse(file.read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.level:
            folder = ".".join(filter(None, (package, node.module)))
            modules |= {alias.name: (f"{folder}.{alias.name}", None) for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            modules |= {alias.name: (node.module, alias.name) for alias in node.names}
    return modules
