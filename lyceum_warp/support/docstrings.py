"""Make ``help()`` show the docstrings of attributes and of overloaded Warp functions.

Python discards a string after an attribute, so ``document_attributes`` reads these strings from the source.
"""

import ast
import dataclasses
import enum
import functools
import inspect
import itertools
from collections.abc import Mapping
from typing import Any, TypeVar

Class = TypeVar("Class", bound=type)


_parse = functools.lru_cache(maxsize=1)(ast.parse)


def attribute_docs(cls: type, *, comments: bool = False) -> dict[str, str]:
    """Return the docstrings of a class's attributes by name, or nothing if there is no source.

    With ``comments``, an attribute without a docstring has the comment on its last line.
    """
    try:
        lines, _ = inspect.findsource(inspect.getmodule(cls) or cls)
        body: list[ast.stmt] = _parse("".join(lines)).body
        for name in cls.__qualname__.split("."):
            body = next(each.body for each in body if isinstance(each, ast.ClassDef) and each.name == name)
    except (OSError, TypeError, SyntaxError, StopIteration):
        return {}
    docs: dict[str, str] = {}
    for statement, following in itertools.pairwise([*body, ast.Pass()]):
        targets = [statement.target] if isinstance(statement, ast.AnnAssign) else getattr(statement, "targets", [None])
        if not isinstance(target := targets[0], ast.Name):
            continue
        text = following.value if isinstance(following, ast.Expr) else None
        comment = lines[(statement.end_lineno or 0) - 1].partition("  # ")[2].strip()
        if isinstance(text, ast.Constant) and isinstance(text.value, str):
            docs[target.id] = inspect.cleandoc(text.value)
        elif comments and comment and not comment.startswith(("fmt:", "noqa", "type:")):
            docs[target.id] = comment
    return docs


def field_docs(cls: type) -> dict[str, str]:
    """Return the docstring or the comment of each field of a struct, or "". ``cls`` is the struct's Python class."""
    docs = dict.fromkeys(inspect.get_annotations(cls), "")
    for base in reversed(cls.__mro__[:-1]):
        docs |= attribute_docs(base, comments=True)
    return docs


def listed(docs: dict[str, str]) -> str:
    """Format names and docstrings as an ``Attributes:`` or ``Args:`` section."""
    entries = (f"{name}: {text}".splitlines() for name, text in docs.items())
    return "\n".join("\n".join(["    " + lines[0], *("        " + line for line in lines[1:])]) for lines in entries)


def document_attributes(cls: Class) -> Class:
    """Append the docstrings of attributes, including inherited ones, to a class's docstring."""
    docs: dict[str, str] = {}
    for base in filter(dataclasses.is_dataclass, reversed(cls.__mro__[1:])):
        docs |= attribute_docs(base)
    docs |= attribute_docs(cls)
    if issubclass(cls, enum.Enum):
        docs = {f"{member.name} ({member.value})": docs[member.name] for member in cls if member.name in docs}
    if docs:
        cls.__doc__ = f"{inspect.cleandoc(cls.__doc__ or '')}\n\nAttributes:\n{listed(docs)}\n"
    return cls


def document_overloads(function: Any) -> None:
    """Give an overloaded Warp function the docstring of its first overload, with the arguments of all overloads."""
    found = [overload.func for overload in (*function.user_overloads.values(), *function.user_templates.values())]
    signatures = dict.fromkeys(f"{function.key}({', '.join(inspect.signature(each).parameters)})" for each in found)
    function.__doc__ = "\n".join([*signatures, "", inspect.cleandoc(found[0].__doc__)])


def document_arguments(function: Any, meanings: Mapping[str, str]) -> None:
    """Append descriptions of arguments to a Warp function's docstring."""
    overloads = (*function.user_overloads.values(), *function.user_templates.values())
    names = dict.fromkeys(name for overload in overloads for name in overload.input_types)
    if names:
        text = listed({name: meanings[name] for name in names})
        function.__doc__ = f"{inspect.cleandoc(function.__doc__)}\n\nArgs:\n{text}\n"
