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
    return _scalar(kind) in _INTEGERS


class _Types:
    """Infers the types of a function's expressions from annotations, literals, conversions and assignments.

    An array's type is a tuple of its number of axes and its element type. None stands for a type that is unknown.
    """

    def __init__(self, function: wp.Function) -> None:
        self.source = source_of(function)
        self._known: dict[str, Any] = {name: _annotated(kind) for name, kind in function.input_types.items()}
        self._assigned: dict[str, list[tuple[ast.expr, int | None]]] = {}
        """The expressions that are assigned to each local variable, each with an index if a tuple is unpacked."""
        for node in _compiled(self.source):
            for target in getattr(node, "targets", [getattr(node, "target", None)]):
                if isinstance(node, ast.For) and isinstance(target, ast.Name):
                    self._known[target.id] = int  # Warp loops over ranges only
                elif (value := getattr(node, "value", None)) is not None:
                    parts = enumerate(target.elts) if isinstance(target, ast.Tuple) else [(None, target)]
                    for index, part in parts:
                        if isinstance(part, ast.Name):
                            self._assigned.setdefault(part.id, []).append((value, index))

    def of(self, node: ast.expr) -> Any:
        """Return the type of an expression."""
        match node:
            case ast.Name(id=name) if name in self.source.locals:
                return self._local(name)
            case ast.Constant(value=value):
                return type(value)
            case ast.UnaryOp(operand=inner) | ast.IfExp(body=inner):
                return self.of(inner)
            case ast.BinOp(left=left, right=right):
                kinds = [self.of(left), self.of(right)]
                return next((kind for kind in kinds if not _is_integer(kind)), kinds[0])
            case ast.Subscript(value=owner, slice=index):
                axes, element = kind if isinstance(kind := self.of(owner), tuple) else (0, _scalar(kind))
                indices = index.elts if isinstance(index, ast.Tuple) else [index]
                axes -= sum(not isinstance(i, ast.Slice) for i in indices)
                return (axes, element) if axes > 0 else element
            case ast.Call() if not self.source.is_static(node):
                return self._result(node)
        if (value := self.source.value(node)) is not None:
            return type(value)
        if isinstance(node, ast.Attribute):
            kind = self.of(node.value)
            if is_struct(kind):
                return _annotated(kind.vars[node.attr].type) if node.attr in kind.vars else None
            return {"shape": (1, int), "size": int}.get(node.attr) if isinstance(kind, tuple) else _scalar(kind)
        return None

    def _local(self, name: str) -> Any:
        if name not in self._known:
            self._known[name] = None  # ends the recursion for x = x + 1
            for value, index in self._assigned.get(name, ()):
                kind = self.of(value.elts[index] if isinstance(value, ast.Tuple) and index is not None else value)
                if index is not None and not isinstance(value, ast.Tuple):  # a function returns a tuple
                    kind = dict(enumerate(typing.get_args(kind))).get(index)
                self._known[name] = self._known[name] or _annotated(kind)
        return self._known[name]

    def _result(self, node: ast.Call) -> Any:
        kind, callee = self.source.call(node)
        if kind == "helper":
            results = [each.adj.arg_types.get("return") for each in overloads(callee)]
            return _annotated(results[0]) if all(result == results[0] for result in results) else None
        if kind == "builtin" and node.args:
            if callee.key in ("int", "len", "randi"):
                return int
            return self.of(node.args[-1]) if callee.key in _LIKE_LAST else getattr(wp, callee.key, None)
        return callee if kind == "other" else None


def _scalar(kind: Any) -> Any:
    return getattr(kind, "_wp_scalar_type_", None if isinstance(kind, tuple) else kind)


def _annotated(kind: Any) -> Any:
    return (kind.ndim, kind.dtype) if is_row(kind) else None if kind is Any else kind
