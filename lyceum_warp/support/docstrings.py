"""Read the docstrings of attributes from the source, and make ``help()`` show them.

An attribute's docstring is the string below it, as Sphinx and type checkers read it. Python discards this string.
"""

import ast
import dataclasses
import enum
import functools
import inspect
import itertools
from collections.abc import Mapping
from typing import TypeVar

Class = TypeVar("Class", bound=type)


_parse = functools.lru_cache(maxsize=1)(ast.parse)


def attribute_docs(*classes: type) -> dict[str, str]:
    """Return the docstrings of the attributes of one or several classes, by name.

    An attribute without a docstring has the comment at the end of its last line.
    """
    docs: dict[str, str] = {}
    for cls in classes:
        try:
            lines, _ = inspect.findsource(inspect.getmodule(cls) or cls)
            body: list[ast.stmt] = _parse("".join(lines)).body
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


def listed(docs: Mapping[str, str]) -> str:
    """Format names and docstrings as an ``Attributes:`` or ``Args:`` section."""
    entries = (f"{name}: {text}".splitlines() for name, text in docs.items())
    return "\n".join("\n".join(["    " + lines[0], *("        " + line for line in lines[1:])]) for lines in entries)


def document_attributes(cls: Class) -> Class:
    """Append the docstrings of attributes, including those of parent dataclasses, to a class's docstring."""
    docs = attribute_docs(*filter(dataclasses.is_dataclass, reversed(cls.__mro__[1:])), cls)
    if issubclass(cls, enum.Enum):
        docs = {f"{member.name} ({member.value})": docs[member.name] for member in cls if member.name in docs}
    if docs:
        cls.__doc__ = f"{inspect.cleandoc(cls.__doc__ or '')}\n\nAttributes:\n{listed(docs)}\n"
    return cls
