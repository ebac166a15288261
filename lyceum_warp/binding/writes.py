"""What a Warp function writes into its arguments, read from its source and from those of the functions that it calls.

Arguments of two kinds can be written: rows, and structs that hold rows. A local name for either is the row itself;
an element that was read from a row is a copy.
"""

import ast
import dataclasses
import functools
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import warp as wp

from lyceum_warp.binding.sources import FunctionSource, has_source, name_of, overloads

_READERS = {
    "len", "lower_bound", "sample_cdf", "print", "printf", "load", "where", "select", "tile_load", "tile_load_indexed",
    "isfinite", "isnan", "isinf", "expect_eq", "expect_neq", "expect_near",
}  # fmt: skip
"""Builtins that only read the arrays that they get; every other one is taken to write them."""

_PASSING = {"where", "select"}
"""Builtins whose result may be one of the arrays that they get."""

_INQUIRIES = {"shape", "ndim", "size", "strides", "dtype", "device"}
"""Attributes of an array that say something about it."""


@dataclasses.dataclass(frozen=True)
class Write:
    """One write into an argument of a function."""

    position: int
    """Number of the argument, from 0."""
    argument: str
    """Name of the argument, as in the function's source."""
    field: str | None
    """The field that is written, where the argument is a struct; None where it is a row."""
    function: str
    """Name of the function in whose source the write stands."""
    file: str
    line: int
    replaced: bool = False
    """Whether the field itself is assigned, as in ``s.time = 0.0``, not an element of its row."""
    reader: str | None = None
    """A function without a source that gets the row, and so may write it; None where the write itself was read."""

    @property
    def target(self) -> str:
        """The argument with its field, as it is written in the source."""
        return self.argument if self.field is None else f"{self.argument}.{self.field}"


@functools.cache
def find_writes(function: wp.Function) -> tuple[Write, ...]:
    """The writes of a function into its arguments, and of the functions that it calls, in the order of its source.

    Handing a row to a function without a source, such as a ``wp.func_native``, counts as a write, with ``reader`` set.
    """
    return tuple(_Analysis(function).writes)


def written_fields(function: wp.Function) -> frozenset[str]:
    """The fields of its struct arguments that a function writes, or may write."""
    return frozenset(write.field for write in find_writes(function) if write.field is not None)


Rights = Mapping[str, Collection[str] | None]
"""What a function may write, by the names of all its arguments in order: fields of a struct, or None for a row that is
a result. An empty collection is nothing."""


def check_writes(task: str, functions: Mapping[str, wp.Function], rights: Mapping[str, Rights]) -> None:
    """Refuse a write where the task's form allows none.

    Args:
        task: The task's name, for messages.
        functions: The task's functions by their names.
        rights: What each of them may write.

    Raises:
        ValueError: A function writes something else.
    """
    for name, function in functions.items():
        allowed = list(rights[name].values())
        for write in find_writes(function):
            fields = allowed[write.position]
            if fields is None or (write.field in fields and not write.replaced):
                continue
            within = "" if write.function == name_of(function) else f" in {write.function}"
            place = f"{within} ({write.file}, line {write.line})"
            if write.reader is not None:
                raise ValueError(
                    f"{name} of the task {task!r} gives {write.target} to {write.reader}{place}, which may write it "
                    "and has no source that can be read: give it numbers instead"
                )
            advice = _advice(write, name, rights)
            raise ValueError(f"{name} of the task {task!r} writes {write.target}{place}: {advice}")


def _advice(write: Write, name: str, rights: Mapping[str, Rights]) -> str:
    """What the form allows, and which function may write the field."""
    may = [field for fields in rights[name].values() for field in fields or ()]
    results = [argument for argument, fields in rights[name].items() if fields is None and argument != "rng"]
    own = f"{name} may write {', '.join(dict.fromkeys([*results, *may])) or 'nothing'}"
    table_name = list(rights[name])[write.position]
    if write.field is None:
        return own
    if table_name == "p":
        return "parameters are changed with env.set_params"
    writers = [
        other for other, row in rights.items() if any(write.field in fields for fields in row.values() if fields)
    ]
    if not writers:
        return f"{own}, and no function may write {write.field}"
    if write.replaced:
        return f"write its elements, as {write.target}[0] = ..."
    if name in writers:
        written = [argument for argument, fields in rights[name].items() if fields and write.field in fields]
        return f"{name} may write {write.field} of {', '.join(written)} only"
    return f"{own}, and {write.field} is written by {' or '.join(writers)}"


@dataclasses.dataclass(frozen=True)
class _Place:
    """Memory of an argument of the analysed function: all of it, a field, a row of a table, or an element."""

    position: int
    field: str | None
    kind: Any
    """A struct; ("array", axes, type of an element); or None for an element, whose value is a copy."""


@dataclasses.dataclass(frozen=True)
class _Calls:
    """A function that an expression stands for."""

    function: Any


_Found = frozenset[_Place | _Calls]
_NOTHING: _Found = frozenset()


class _Analysis:
    """Follows the arguments of a function through its source and through the functions that it calls."""

    def __init__(self, function: wp.Function) -> None:
        self.root = function
        self.names = list(function.input_types)
        self.writes: dict[Write, None] = {}
        self._results: dict[Any, _Found] = {}
        arguments = [
            frozenset([_Place(i, None, kind)]) if (kind := _kind(written)) is not None else _NOTHING
            for i, written in enumerate(function.input_types.values())
        ]
        if has_source(function):
            self.visit(function, arguments)
        else:
            for found in arguments:
                self._note_unread(found, name_of(function), "", name_of(function), 0)

    def visit(self, function: wp.Function, arguments: list[_Found]) -> _Found:
        """Note the writes of a function that gets some arguments; returns what its result may be."""
        key = (function, *arguments)
        if key not in self._results:
            self._results[key] = _NOTHING  # for a function that calls itself
            self._results[key] = _Visit(self, FunctionSource(function), arguments).result
        return self._results[key]

    def note(self, found: _Found, source: FunctionSource, node: ast.AST, *, replaced: bool = False) -> None:
        """Note a write to some places."""
        for place in _places(found):
            self._add(Write(place.position, self.names[place.position], place.field, source.name, source.file,
                            source.line(node), replaced))  # fmt: skip

    def note_unread(self, found: _Found, reader: str, source: FunctionSource, node: ast.AST) -> None:
        """Note that a function without a source gets some places."""
        self._note_unread(found, source.name, source.file, reader, source.line(node))

    def _note_unread(self, found: _Found, function: str, file: str, reader: str, line: int) -> None:
        for place in _places(found):
            fields: Iterable[str | None] = [place.field]
            if place.field is None and _is_struct(place.kind):
                fields = [name for name, variable in place.kind.vars.items() if _kind(variable.type) is not None]
            for field in fields:
                self._add(Write(place.position, self.names[place.position], field, function, file, line, reader=reader))

    def _add(self, write: Write) -> None:
        self.writes[write] = None


class _Visit:
    """One function with the arguments that it gets: what its local names stand for, what it writes and returns."""

    def __init__(self, analysis: _Analysis, source: FunctionSource, arguments: list[_Found]) -> None:
        self.analysis, self.source = analysis, source
        self.names: dict[str, _Found] = dict(zip((a.arg for a in source.tree.args.args), arguments, strict=True))
        self.result = _NOTHING
        known = None
        while known != self.names:  # a loop may use a name before the line that assigns it
            known = dict(self.names)
            self._run(source.tree.body)

    def _run(self, body: Iterable[ast.stmt]) -> None:
        for statement in body:
            if isinstance(statement, ast.If) and (chosen := self.source.condition(statement.test)) is not None:
                self._run(statement.body if chosen else statement.orelse)
                continue
            for expression in _own_expressions(statement):
                self._calls(expression)
            if isinstance(statement, ast.Assign):
                for target in statement.targets:
                    self._assign(target, statement.value)
            elif isinstance(statement, ast.AugAssign | ast.AnnAssign):
                self._assign(statement.target, statement.value)
            elif isinstance(statement, ast.Return) and statement.value is not None:
                self.result |= self._value(statement.value)
            for name in ("body", "orelse"):
                self._run(getattr(statement, name, ()))

    def _assign(self, target: ast.expr, value: ast.expr | None) -> None:
        if isinstance(target, ast.Tuple | ast.List):
            values = value.elts if isinstance(value, ast.Tuple | ast.List) else []
            paired = values if len(values) == len(target.elts) else [value] * len(target.elts)
            for part, own in zip(target.elts, paired, strict=True):
                self._assign(part, own)
        elif isinstance(target, ast.Starred):
            self._assign(target.value, value)
        elif isinstance(target, ast.Name):
            found = self.names.get(target.id, _NOTHING)
            for place in _places(found):
                if place.kind is _REFERENCE:
                    self.analysis.note(frozenset([place]), self.source, target)
            if value is not None:
                self.names[target.id] = found | self._value(value)
        else:
            owners = _places(self._memory(target.value)) if isinstance(target, ast.Attribute) else []
            if all(isinstance(owner.kind, tuple) for owner in owners):  # rows in a struct of the function's own
                owners = []
            if owners or not isinstance(target, ast.Attribute):
                replaced = any(owner.field is None and _is_struct(owner.kind) for owner in owners)
                self.analysis.note(self._memory(target), self.source, target, replaced=replaced)
            root = target
            while isinstance(root, ast.Attribute | ast.Subscript):
                root = root.value
            # a struct of the function's own may get a row
            if value is not None and isinstance(root, ast.Name) and isinstance(target, ast.Attribute) and not owners:
                self.names[root.id] = self.names.get(root.id, _NOTHING) | self._value(value)

    def _value(self, node: ast.expr) -> _Found:
        """What an expression stands for: rows and structs of the arguments, and functions; elements are copies."""
        return frozenset(found for found in self._memory(node) if isinstance(found, _Calls) or not _is_element(found))

    def _memory(self, node: ast.expr) -> _Found:
        """The memory that an expression names, elements too."""
        if isinstance(node, ast.Name) and node.id in self.names:
            return self.names[node.id]
        if isinstance(node, ast.Attribute):
            inner = self._memory(node.value)
            if inner:
                return frozenset(part for place in _places(inner) for part in _attribute(place, node.attr))
        if isinstance(node, ast.Subscript):
            return frozenset(_element(place, node.slice) for place in _places(self._memory(node.value)))
        if isinstance(node, ast.IfExp):
            return self._memory(node.body) | self._memory(node.orelse)
        if isinstance(node, ast.Tuple | ast.List):
            return frozenset(found for part in node.elts for found in self._value(part))
        if isinstance(node, ast.Call) and not self.source.is_static(node):
            return self._call(node)
        value = self.source.value(node)
        return frozenset([_Calls(value)]) if isinstance(value, wp.Function) else _NOTHING

    def _calls(self, expression: ast.expr) -> None:
        """Follow the calls within an expression."""
        if self.source.is_static(expression):
            return
        if isinstance(expression, ast.Call):
            self._call(expression)
        if isinstance(expression, ast.Attribute) and expression.attr == "ptr":
            self.analysis.note_unread(self._memory(expression.value), "a pointer", self.source, expression)
        for child in ast.iter_child_nodes(expression):
            if isinstance(child, ast.expr):
                self._calls(child)
            elif isinstance(child, ast.keyword):
                self._calls(child.value)

    def _call(self, node: ast.Call) -> _Found:
        """Note the writes of a call; returns what its result may be."""
        given = [*node.args, *(keyword.value for keyword in node.keywords)]
        callees = [found.function for found in self._memory(node.func) if isinstance(found, _Calls)]
        if not callees:
            if (value := self.source.value(node.func)) is None or value is wp.address_of:
                if isinstance(node.func, ast.Attribute):
                    given.append(node.func.value)  # a method
                for argument in given:
                    found = self._value(argument) if value is None else self._memory(argument)
                    self.analysis.note_unread(found, ast.unparse(node.func), self.source, node)
            # a struct or another type may hold the rows that it is made from
            return frozenset(found for argument in given for found in self._value(argument))
        result = _NOTHING
        for callee in callees:
            if callee.func is None:
                result |= self._call_builtin(callee, node, given)
            else:
                for overload in overloads(callee):
                    result |= self._call_function(overload, node)
        return result

    def _call_builtin(self, callee: wp.Function, node: ast.Call, given: list[ast.expr]) -> _Found:
        values = frozenset(found for argument in given for found in self._value(argument))
        if callee.key not in _READERS:
            self.analysis.note(values, self.source, node)
        return values if callee.key in _PASSING else _NOTHING

    def _call_function(self, callee: wp.Function, node: ast.Call) -> _Found:
        names = list(callee.input_types)
        bound: dict[str, ast.expr] = dict(zip(names, node.args, strict=False))
        bound |= {keyword.arg: keyword.value for keyword in node.keywords if keyword.arg in names}
        arguments = []
        for name in names:
            expected, found = callee.input_types[name], _NOTHING
            if name in bound:
                found = self._memory(bound[name]) if _is_reference(expected) else self._value(bound[name])
            if any(not _fits(place.kind, expected) for place in _places(found)):
                return _NOTHING  # another overload
            if _is_reference(expected):
                found = frozenset(_Place(place.position, place.field, _REFERENCE) for place in _places(found))
            arguments.append(found)
        if not has_source(callee):
            for found in arguments:
                self.analysis.note_unread(found, name_of(callee), self.source, node)
            return _NOTHING
        return self.analysis.visit(callee, arguments)


_REFERENCE = "reference"
"""The kind of an element that a function got as a ``wp.ref``: assigning its name writes it."""


def _own_expressions(statement: ast.stmt) -> list[ast.expr]:
    """The expressions of a statement, without those of statements within it."""
    return [child for child in ast.iter_child_nodes(statement) if isinstance(child, ast.expr)]


def _places(found: _Found) -> list[_Place]:
    """The places among what an expression stands for, in a fixed order."""
    places = [place for place in found if isinstance(place, _Place)]
    return sorted(places, key=lambda place: (place.position, place.field or ""))


def _is_struct(kind: Any) -> bool:
    return hasattr(kind, "vars") and hasattr(kind, "cls")


def _is_reference(expected: Any) -> bool:
    return hasattr(expected, "value_type") and not isinstance(expected, wp.array)


def _is_element(place: _Place) -> bool:
    return place.kind is None or place.kind is _REFERENCE


def _kind(written: Any) -> Any:
    """A type as ``_Place.kind`` has it; None for numbers, vectors and matrices."""
    if _is_struct(written):
        return written
    if hasattr(written, "ndim") and hasattr(written, "dtype"):
        return ("array", written.ndim, written.dtype)
    return None


def _fits(kind: Any, expected: Any) -> bool:
    """Whether an argument of some kind can be that of an overload, as far as rows and structs are concerned."""
    if _is_element(_Place(0, None, kind)):
        return True
    wanted = _kind(expected)
    if wanted is None:
        return expected is Any or _is_reference(expected)
    if isinstance(kind, tuple) and isinstance(wanted, tuple):
        return kind[1] == wanted[1] or wanted[2] is Any
    return bool(kind is wanted)


def _attribute(place: _Place, name: str) -> list[_Place]:
    if _is_struct(place.kind):
        variable = place.kind.vars.get(name)
        return [_Place(place.position, place.field or name, _kind(variable.type) if variable else None)]
    if isinstance(place.kind, tuple) and name in _INQUIRIES | {"ptr"}:
        return []
    return [place]  # a component, or a field of a struct that holds the row


def _element(place: _Place, index: ast.expr) -> _Place:
    if not isinstance(place.kind, tuple):
        return place
    indices = index.elts if isinstance(index, ast.Tuple) else [index]
    axes = place.kind[1] - sum(not isinstance(i, ast.Slice) for i in indices)
    kind = ("array", axes, place.kind[2]) if axes > 0 else _kind(place.kind[2])
    return _Place(place.position, place.field, kind)
