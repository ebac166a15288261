"""Find all places where a Warp function, or a function that it calls, reads or writes its arguments.

The analysis follows a row into its elements and their components, into calls, local variables and local structs. Any
other use of a row counts as a write, for example returning it or passing it to a native function.
"""

import ast
import dataclasses
import functools
from collections.abc import Collection, Mapping
from typing import Any

import warp as wp

from lyceum_warp.binding.sources import has_source, is_row, is_struct, name_of, overloads, source_of
from lyceum_warp.core.fields import DERIVED_FIELDS

_READERS = {"len", "lower_bound", "sample_cdf", "print", "printf"}

_INQUIRIES = {"shape", "ndim", "size", "strides", "dtype", "device"}
"""Attributes of an array that do not refer to its elements."""


@dataclasses.dataclass(frozen=True)
class Write:
    """A write into an argument of a function."""

    position: int
    field: str | None
    """None for a row."""
    target: str
    """The argument with its field, such as "s.qpos"."""
    function: str
    place: str
    """The file and the line of the write."""
    replaced: bool = False
    """Whether the write assigns the field itself, as ``s.time = 0.0`` does. Other writes change an element of a row."""
    use: str | None = None
    """An expression that may write the row, such as a call of a native function. None if the write is certain."""


@dataclasses.dataclass
class Trace:
    """What a function and its callees do."""

    arguments: list[str]
    """The names of the function's arguments."""
    writes: dict[Write, None] = dataclasses.field(default_factory=dict)
    """The writes into the arguments, in source order."""
    reads: dict[str, str] = dataclasses.field(default_factory=dict)
    """The struct fields whose elements are read, each with the function and the line that read it first."""
    calls: dict[Any, None] = dataclasses.field(default_factory=dict)
    """The analysed calls, each as a function and its ``places``."""

    @property
    def functions(self) -> list[wp.Function]:
        """The function and its callees with Python source."""
        return list(dict.fromkeys(function for function, *_ in self.calls))


@functools.cache
def trace(function: wp.Function) -> Trace:
    """Analyse a function and its callees."""
    kinds = enumerate(map(_kind, function.input_types.values()))
    places = tuple(None if kind is None else _Place(i, None, kind) for i, kind in kinds)
    result = Trace(list(function.input_types))
    if has_source(function):
        _read_function(function, places, result)
    else:
        name = name_of(function)
        unknown = (Write(i, None, argument, name, name, use=name) for i, argument in enumerate(result.arguments))
        result.writes = {write: None for write in unknown if places[write.position]}
    return result


def written_fields(function: wp.Function) -> frozenset[str]:
    """Return the names of the struct fields that a function writes, or may write."""
    return frozenset(write.field for write in trace(function).writes if write.field is not None)


Rights = Mapping[str, Collection[str] | None]
"""Maps each argument of a function to the fields that the function may write. For an output row, the value is None."""


def check_writes(name: str, function: wp.Function, rights: Mapping[str, Rights]) -> None:
    """Raise a ValueError if a function of a task writes a field or a row that it must not write.

    ``rights`` has the rights of all functions by name.
    """
    allowed = list(rights[name].values())
    for write in trace(function).writes:
        fields = allowed[write.position]
        if (fields is None or write.field in fields) and not write.replaced:
            continue
        within = "" if write.function == name_of(function) else f" in {write.function}"
        place = f"{within} ({write.place})"
        if write.use is not None:
            raise ValueError(
                f"{name} uses {write.target} as a whole in '{write.use}'{place}, and may write it there: read and "
                "write its elements directly"
            )
        raise ValueError(f"{name} writes {write.target}{place}: {_advice(write, name, rights)}")


def check_reads(name: str, function: wp.Function) -> None:
    """Raise a ValueError if a function that changes the initial state reads a field that MuJoCo computes from it."""
    for field, place in trace(function).reads.items():
        if field in DERIVED_FIELDS or field == "sensordata":
            raise ValueError(
                f"{name} reads {field} in {place}, but MuJoCo computes {field} after {name}, so the values are those "
                "of an earlier state: compute them from qpos and qvel"
            )


def _advice(write: Write, name: str, rights: Mapping[str, Rights]) -> str:
    argument = list(rights[name])[write.position]
    if argument == "p":
        return "parameters are changed with env.set_params"
    writers = [
        other for other, row in rights.items() if any(write.field in fields for fields in row.values() if fields)
    ]
    if write.replaced and (writers or rights[name][argument] is None):
        return f"write its elements, as {write.target}[0] = ..."
    targets = [argument for argument, fields in rights[name].items() if fields is None and argument != "rng"]
    targets += [f"{argument}.{field}" for argument, fields in rights[name].items() for field in fields or ()]
    others = f", and {write.field} is written by {' or '.join(writers)}" if writers and name not in writers else ""
    return f"{name} may write {', '.join(targets) or 'nothing'}{others}"


@dataclasses.dataclass(frozen=True)
class _Place:
    """The part of an argument to which an expression refers: the whole argument, a field, a row or an element."""

    position: int
    field: str | None
    kind: Any
    """The type of a struct, or an array's number of axes and element type. None for an element."""

    def attribute(self, name: str) -> "_Place | None":
        if is_struct(self.kind):
            variable = self.kind.vars.get(name)
            return _Place(self.position, self.field or name, variable and _kind(variable.type))
        return None if self.kind is not None and name in _INQUIRIES else self  # a component, or a pointer

    def element(self, index: ast.expr) -> "_Place":
        if not isinstance(self.kind, tuple):
            return self
        axes, dtype = self.kind
        axes -= sum(not isinstance(i, ast.Slice) for i in (index.elts if isinstance(index, ast.Tuple) else [index]))
        return dataclasses.replace(self, kind=(axes, dtype) if axes > 0 else _kind(dtype))


def _kind(written: Any) -> Any:
    return written if is_struct(written) else (written.ndim, written.dtype) if is_row(written) else None


def _read_function(function: wp.Function, places: tuple[_Place | None, ...], trace: Trace) -> None:
    """Analyse a function for the values that its caller passes. A value that cannot be written is None."""
    if (key := (function, *places)) not in trace.calls:
        trace.calls[key] = None
        _Reader(function, places, trace)


class _Reader:
    """Reads the source of one function and of its callees, and adds to a trace."""

    def __init__(self, function: wp.Function, places: tuple[_Place | None, ...], trace: Trace) -> None:
        self.trace, self.source = trace, source_of(function)
        # a key is a name, or "name.field" for a row in a local struct
        self.places: dict[str, _Place | None] = dict(zip(function.input_types, places, strict=True))
        # read loops twice: a local struct may be used before the line that puts a row into it
        for _ in range(2 if self.source.has_loops else 1):
            for statement in self.source.tree.body:
                self._read(statement)

    def _note(self, place: _Place, node: ast.AST, *, replaced: bool = False, follows: bool = True) -> None:
        """Record a write. ``follows=False`` marks a use of the row that cannot be analysed, and may be a write."""
        use = None if follows else ast.unparse(node).splitlines()[0]
        target = ".".join(filter(None, (self.trace.arguments[place.position], place.field)))
        where = self.source.place(node)
        self.trace.writes[Write(place.position, place.field, target, self.source.name, where, replaced, use)] = None

    def _note_read(self, place: _Place | None, node: ast.AST) -> None:
        if place and place.field:
            self.trace.reads.setdefault(place.field, f"{self.source.name} ({self.source.place(node)})")

    def _read(self, node: ast.AST) -> _Place | None:
        """Record the writes of a syntax node. If the node is an expression, return its ``_Place``."""
        if isinstance(node, ast.Name):
            for name, place in self.places.items():
                if place is not None and name.startswith(f"{node.id}."):  # a local struct of rows, used as a whole
                    self._note(place, node, follows=False)
            return self.places.get(node.id)
        if isinstance(node, ast.Attribute):
            local = node.value.id if isinstance(node.value, ast.Name) else None
            owner = self._read(node.value) if local is None else self.places.get(local)
            return owner.attribute(node.attr) if owner else self.places.get(f"{local}.{node.attr}")
        if isinstance(node, ast.Subscript):
            self._read_all(node, [node.slice])
            owner = self._read(node.value)
            if isinstance(node.ctx, ast.Load):
                self._note_read(owner, node)
            return owner and owner.element(node.slice)
        if isinstance(node, ast.Call):
            self._call(node)
        elif isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
            self._assign(node)
        elif isinstance(node, ast.If) and (chosen := self.source.condition(node.test)) is not None:
            self._read_all(node, node.body if chosen else node.orelse)
        else:
            self._read_all(node, ast.iter_child_nodes(node))
        return None

    def _read_all(self, parent: ast.AST, nodes: Any, *, elements: bool = False) -> None:
        """Read the children of a syntax node. A child that uses a row as a whole counts as a write."""
        for node in nodes:
            place = self._read(node)
            if place is not None and (elements or place.kind is not None):
                self._note(place, parent, follows=False)

    def _assign(self, node: ast.Assign | ast.AugAssign | ast.AnnAssign) -> None:
        place = self._read(node.value) if node.value is not None else None
        whole = place if place is not None and place.kind is not None else None
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            target_place = None
            if not self._is_local(target):
                self._store(target)
            elif whole is not None:
                name = ast.unparse(target)
                target_place = self.places[name] = self.places.get(name) or whole
            if whole is not None and target_place != whole:
                for lost in filter(None, (target_place, whole)):
                    self._note(lost, node, follows=False)

    def _is_local(self, target: ast.expr) -> bool:
        owner = target.value if isinstance(target, ast.Attribute) else None
        return isinstance(target, ast.Name) or (isinstance(owner, ast.Name) and owner.id not in self.places)

    def _store(self, target: ast.expr) -> None:
        if isinstance(target, ast.Tuple | ast.List):
            for part in target.elts:
                self._store(part)
        elif isinstance(target, ast.Attribute | ast.Subscript) and (place := self._read(target)) is not None:
            owner = self._read(target.value)
            replaced = isinstance(target, ast.Attribute) and owner is not None and is_struct(owner.kind)
            self._note(place, target, replaced=replaced)

    def _call(self, node: ast.Call) -> None:
        kind, callee = self.source.call(node)
        arguments = [*node.args, *(keyword.value for keyword in node.keywords)]
        if kind == "helper":
            for overload in overloads(callee):
                self._call_helper(overload, node)
        elif kind == "builtin" and callee.key in _READERS:
            for argument in arguments:
                place = self._read(argument)
                if callee.key != "len":
                    self._note_read(place, node)
        elif kind == "other":
            self._read_all(node, [node.func, *arguments], elements=callee is wp.address_of)
        elif kind != "static":
            self._read_all(node, arguments)

    def _call_helper(self, callee: wp.Function, node: ast.Call) -> None:
        expressions: dict[str, ast.expr] = dict(zip(callee.input_types, node.args, strict=False))
        expressions |= {keyword.arg: keyword.value for keyword in node.keywords if keyword.arg}
        places = {name: place for name, value in expressions.items() if (place := self._read(value)) is not None}
        arguments: list[_Place | None] = []
        for name, expected in callee.input_types.items():
            place = places.get(name)
            if hasattr(expected, "value_type") and place is not None:  # a wp.ref
                self._note(place, node, follows=False)
            if place is None or place.kind is None:
                arguments.append(None)
            elif expected is Any or type(place.kind) is type(_kind(expected)):
                arguments.append(place)
            else:
                return  # another overload
        _read_function(callee, tuple(arguments), self.trace)
