"""Parse the source of a Warp function, resolve its names and calls, and run generated source."""

import ast
import builtins
import functools
import linecache
import re
import types
from pathlib import Path
from typing import Any, Literal

import warp as wp

from lyceum_warp.support.upstream import builtin_functions


class FunctionSource:
    """Holds the source that a ``wp.func`` had when it was defined, even if the file has changed since then."""

    def __init__(self, function: wp.Function) -> None:
        adj: Any = function.adj
        body = ast.parse(adj.source).body
        if len(body) != 1 or not isinstance(body[0], ast.FunctionDef):
            raise ValueError(f"the source of {name_of(function)} is not a function definition that starts with def")
        self.function = function
        self.tree = body[0]
        self.name = name_of(function)
        self.file = Path(adj.filename).name
        self._first_line: int = adj.fun_lineno
        self.scope = _scope(function.func)
        nodes = list(ast.walk(self.tree))
        self.has_loops = any(isinstance(node, ast.For | ast.While) for node in nodes)
        self.locals = {argument.arg for argument in self.tree.args.args} | {
            node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        }

    def place(self, node: ast.AST) -> str:
        """Return the file and the line of a node, for messages."""
        return f"{self.file}, line {self._first_line + getattr(node, 'lineno', 1) - 1}"

    def value(self, node: ast.expr) -> Any:
        """Evaluate a name, a path such as ``module.helper`` or a ``wp.static(...)``. Return None if that fails."""
        if isinstance(node, ast.Name):
            if node.id in self.locals:
                return None
            return self.scope.get(node.id, builtin(node.id))
        if isinstance(node, ast.Attribute):
            owner = self.value(node.value)
            if owner is None:
                return None
            return getattr(owner, node.attr, builtin(node.attr) if owner is wp else None)
        if self.is_static(node):
            assert isinstance(node, ast.Call)
            try:
                return eval(ast.unparse(node.args[0]), dict(self.scope))
            except Exception:  # the argument may use unknown names, such as the counter of a loop that Warp unrolls
                return None
        return None

    def is_static(self, node: ast.AST) -> bool:
        """Whether a node is ``wp.static(...)``. Warp replaces it with the value of its argument."""
        return (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name | ast.Attribute)
            and self.value(node.func) is wp.static
            and len(node.args) == 1
        )

    def call(self, node: ast.Call) -> tuple[Literal["static", "helper", "native", "builtin", "other"], Any]:
        """Return a call's kind and its callee.

        A "helper" is a function with Python source, and a "native" function is a ``wp.func_native``.
        """
        callee = self.value(node.func)
        if self.is_static(node):
            return "static", callee
        if not isinstance(callee, wp.Function):
            return "other", callee
        if callee.func is None:
            return "builtin", callee
        return "helper" if has_source(callee) else "native", callee

    def condition(self, node: ast.expr) -> bool | None:
        """Evaluate a condition that is a ``wp.static(...)``. Return None for any other condition."""
        value = self.value(node) if self.is_static(node) else None
        return None if value is None else bool(value)


source_of = functools.cache(FunctionSource)
"""Parse a function's source only once. The syntax tree is shared, so it must not be changed."""


def has_source(function: wp.Function) -> bool:
    """Whether a function has Python source. A builtin and a ``wp.func_native`` have none."""
    return function.func is not None and function.native_snippet is None


def is_struct(kind: Any) -> bool:
    """Whether a type is a ``wp.struct``."""
    return hasattr(kind, "vars") and hasattr(kind, "cls")


def is_row(kind: Any) -> bool:
    """Whether a type is an array."""
    return hasattr(kind, "ndim") and hasattr(kind, "dtype")


def name_of(function: wp.Function) -> str:
    """Return a function's Python name, or Warp's name if the function is native."""
    return function.func.__name__ if function.func is not None else function.key


def builtin(name: str) -> Any:
    """Find a builtin function of Warp or Python."""
    return builtin_functions().get(name) or getattr(wp, name, None) or getattr(builtins, name, None)


def overloads(function: wp.Function) -> list[wp.Function]:
    """Return those overloads of a function that have Python source."""
    candidates = [*function.user_overloads.values(), *function.user_templates.values()]
    # the overloads include the instances that Warp has made of a generic function
    return [overload for overload in candidates if overload.generic_parent is None] or [function]


def _scope(function: Any) -> dict[str, Any]:
    assert isinstance(function, types.FunctionType)
    scope = dict(function.__globals__)
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            scope[name] = cell.cell_contents
        except ValueError:  # the enclosing function has not assigned this variable yet
            scope.pop(name, None)
    return scope


_module_names: set[str] = set()


def free_module_name(name: str) -> str:
    """Return an unused name for a Warp module. Warp's cache needs the same name in every process."""
    free = name = re.sub(r"[^\w.]", "_", name)
    number = 0
    while free in _module_names:
        number += 1
        free = f"{name}_{number}"
    _module_names.add(free)
    return free


def run_source(text: str, file: str, scope: dict[str, Any]) -> None:
    """Run generated source in a scope. Store the source in linecache, because Warp reads it from there."""
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    exec(compile(text, file, "exec"), scope)
