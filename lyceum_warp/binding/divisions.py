"""Find divisions of integers in Warp functions: unlike Python, Warp drops the fraction of the quotient."""

import ast
import functools
import typing
from collections.abc import Iterator
from typing import Any

import warp as wp

from lyceum_warp.binding.sources import FunctionSource, is_row, is_struct, overloads, source_of
from lyceum_warp.binding.writes import trace

_INTEGERS = (int, wp.int8, wp.uint8, wp.int16, wp.uint16, wp.int32, wp.uint32, wp.int64, wp.uint64)

_LIKE_LAST = {"abs", "clamp", "max", "min", "mod", "sign", "where"}
"""Builtin functions whose result has the type of the last argument."""


def check_divisions(task: str, name: str, function: wp.Function) -> None:
    """Raise a ValueError if a function of a task, or a function that it calls, divides integers by ``/``."""
    for each in trace(function).functions:
        source = source_of(each)
        for division in integer_divisions(each):
            left, right = division.left, division.right
            within = "" if each is function else f" in {source.name}"
            raise ValueError(
                f"{name} of the task {task!r} divides integers in '{ast.unparse(division)}'{within} "
                f"({source.place(division)}), and Warp drops the fraction: write {_as_float(left)} / "
                f"{_as_float(right)}, or {ast.unparse(left)} // {ast.unparse(right)} for a whole quotient"
            )


def _as_float(node: ast.expr) -> str:
    text = ast.unparse(node)
    return f"{text}.0" if text.isdigit() else f"float({text})"


@functools.cache
def integer_divisions(function: wp.Function) -> list[ast.BinOp]:
    """Return the divisions by ``/`` in a function's own source whose operands are known to be integers."""
    if "/" not in function.adj.source:
        return []
    types, found = _Types(function), []
    for node in _compiled(types.source):
        if isinstance(node, ast.AugAssign):
            node = ast.copy_location(ast.BinOp(node.target, node.op, node.value), node)
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
            kinds = [types.of(node.left), types.of(node.right)]
            if any(map(_is_integer, kinds)) and all(kind is None or _is_integer(kind) for kind in kinds):
                found.append(node)
    return sorted(found, key=lambda node: node.lineno)


def _compiled(source: FunctionSource) -> Iterator[ast.AST]:
    """Yield the nodes of a function's body, except arguments of ``wp.static``, which Python evaluates."""
    nodes: list[ast.AST] = [*source.tree.body]
    for node in nodes:  # the list grows during the loop
        yield node
        if not source.is_static(node):
            nodes += ast.iter_child_nodes(node)


def _is_integer(kind: Any) -> bool:
    return getattr(kind, "_wp_scalar_type_", kind) in _INTEGERS


class _Types:
    """Infers the types of a function's expressions from annotations, literals, conversions and assignments.

    None stands for a type that is unknown.
    """

    def __init__(self, function: wp.Function) -> None:
        self.source = source_of(function)
        self._known: dict[str, Any] = {name: _annotated(kind) for name, kind in function.input_types.items()}
        self._assigned: dict[str, list[tuple[ast.expr, int | None]]] = {}
        """The expressions that are assigned to each local variable, each with an index if a tuple is unpacked."""
        for node in _compiled(self.source):
            if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
                for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                    parts = target.elts if isinstance(target, ast.Tuple) else []
                    for name, index in ((target, None), *((part, i) for i, part in enumerate(parts))):
                        if isinstance(name, ast.Name):
                            self._assigned.setdefault(name.id, []).append((node.value, index))
            elif isinstance(node, ast.For) and isinstance(node.target, ast.Name):
                self._known[node.target.id] = int  # Warp loops over ranges only

    def of(self, node: ast.expr) -> Any:
        """Return the type of an expression. An array is a tuple of its number of axes and its element type."""
        match node:
            case ast.Name(id=name) if name in self.source.locals:
                return self._local(name)
            case ast.Constant(value=value):
                return type(value)
            case ast.Attribute(value=owner, attr=name) if self.source.value(node) is None:
                kind = self.of(owner)
                if is_struct(kind):
                    return _annotated(kind.vars[name].type) if name in kind.vars else None
                if isinstance(kind, tuple):
                    return {"shape": (1, int), "size": int, "ndim": int}.get(name)
                return getattr(kind, "_wp_scalar_type_", None)
            case ast.Subscript(value=owner, slice=index):
                return self._element(self.of(owner), index)
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() | ast.Invert(), operand=operand):
                return self.of(operand)
            case ast.BinOp(left=left, right=right):
                kinds = [self.of(left), self.of(right)]
                return next((kind for kind in kinds if not _is_integer(kind)), kinds[0])
            case ast.IfExp(body=body):
                return self.of(body)
            case ast.Call():
                return self._result(node)
            case ast.Name() | ast.Attribute():
                value = self.source.value(node)
                return None if value is None else type(value)
        return None

    def _local(self, name: str) -> Any:
        if name not in self._known:
            self._known[name] = None  # ends the recursion for x = x + 1
            kinds = (self._part(value, index) for value, index in self._assigned.get(name, ()))
            self._known[name] = next((kind for kind in kinds if kind is not None), None)
        return self._known[name]

    def _part(self, value: ast.expr, index: int | None) -> Any:
        if index is None:
            return self.of(value)
        if isinstance(value, ast.Tuple):
            return self.of(value.elts[index])
        kinds = typing.get_args(self.of(value))
        return _annotated(kinds[index]) if index < len(kinds) else None

    def _element(self, kind: Any, index: ast.expr) -> Any:
        if not isinstance(kind, tuple):
            return getattr(kind, "_wp_scalar_type_", None)
        axes, element = kind
        axes -= sum(not isinstance(i, ast.Slice) for i in (index.elts if isinstance(index, ast.Tuple) else [index]))
        return (axes, element) if axes > 0 else element

    def _result(self, node: ast.Call) -> Any:
        kind, callee = self.source.call(node)
        if kind == "static":
            value = self.source.value(node)
            return None if value is None else type(value)
        if kind == "helper":
            results = [each.adj.arg_types.get("return") for each in overloads(callee)]
            return _annotated(results[0]) if all(result == results[0] for result in results) else None
        if kind == "builtin" and node.args:
            if callee.key in ("len", "int"):
                return int
            return self.of(node.args[-1]) if callee.key in _LIKE_LAST else getattr(wp, callee.key, None)
        return callee if kind == "other" else None


def _annotated(kind: Any) -> Any:
    return (kind.ndim, kind.dtype) if is_row(kind) else None if kind is Any else kind
