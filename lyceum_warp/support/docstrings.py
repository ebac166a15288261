"""Read the docstrings of attributes from the source, and make ``help()`` show them.

An attribute's docstring is the string below it, as Sphinx and type checkers read it. Python discards this string.
"""

import ast
import dataclasses
import enum
import importlib.util
import inspect
import itertools
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type)


def attribute_docs(*classes: type) -> dict[str, str]:
    """Return the docstrings of the attributes of one or several classes, by name.

    An attribute without a docstring has the comment at the end of its last line.
    """
    docs: dict[str, str] = {}
    for cls in classes:
        try:
            lines = _lines(cls)
            body: list[ast.stmt] = ast.parse("".join(lines)).body
            for name in cls.__qualname__.split("."):
                body = next(each.body for each in body if isinstance(each, ast.ClassDef) and each.name == name)
        except (OSError, TypeError, SyntaxError, StopIteration):  # a class without source, as in an interactive session
            continue
        for statement, following in itertools.pairwise([*body, ast.Pass()]):
            target = getattr(statement, "target", None) or getattr(statement, "targets", [None])[0]
            if not isinstance(statement, ast.Assign | ast.AnnAssign) or not isinstance(target, ast.Name):
                continue
            text = following.value if isinstance(following, ast.Expr) else None
            comment = lines[(statement.end_lineno or 0) - 1].partition("  # ")[2].strip()
            if isinstance(text, ast.Constant) and isinstance(text.value, str):
                docs[target.id] = inspect.cleandoc(text.value)
            elif comment and not comment.startswith(("fmt:", "noqa", "type:")):
                docs[target.id] = comment
    return docs


def _lines(cls: type) -> list[str]:
    """Return the source of a class's module, which need not be loaded."""
    if cls.__module__ in sys.modules:
        return inspect.findsource(inspect.getmodule(cls) or cls)[0]
    spec = importlib.util.find_spec(cls.__module__)
    return Path(str(spec and spec.origin)).read_text("utf-8").splitlines(keepends=True)


def listed(docs: Mapping[str, str]) -> str:
    """Format names and docstrings as an ``Attributes:`` or ``Args:`` section."""
    entries = (f"{name}: {text}".splitlines() for name, text in docs.items())
    return "\n".join("\n".join(["    " + lines[0], *("        " + line for line in lines[1:])]) for lines in entries)


def document_attributes(cls: Class) -> Class:
    """Append the docstrings of attributes, including those of parent dataclasses, to a class's docstring."""
    documented: Any = cls
    if isinstance(vars(cls).get("__doc__"), _Doc):
        return cls
    doc = _Doc(cls.__doc__)
    documented.__doc__ = doc if type(cls) is type else doc.__get__(None, cls)  # pydoc reads __doc__ past a metaclass
    return cls


class _Doc:
    """The docstring of a class, which lists its attributes. They are read from the source when ``help()`` asks."""

    def __init__(self, text: str | None) -> None:
        self._text = text

    def __get__(self, instance: object, cls: type) -> str | None:
        docs = attribute_docs(*filter(dataclasses.is_dataclass, reversed(cls.__mro__[1:])), cls)
        if issubclass(cls, enum.Enum):
            docs = {f"{member.name} ({member.value})": docs[member.name] for member in cls if member.name in docs}
        return f"{inspect.cleandoc(self._text or '')}\n\nAttributes:\n{listed(docs)}\n" if docs else self._text
