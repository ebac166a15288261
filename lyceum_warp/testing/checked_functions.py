"""Copy a task's functions with a bounds check for every index, and make kernels that run the copies.

Native functions (``wp.func_native``) are C++ and cannot be checked.
"""

import ast
import copy
from collections.abc import Mapping
from typing import Any

import warp as wp

from lyceum_warp.binding import FunctionSource, is_row, is_struct, name_of, overloads, sources
from lyceum_warp.kernels import index_checks

_SHAPES = ("shape", "strides")


_HELPERS = {
    "bounds_at": index_checks.at, "bounds_from_end": index_checks.from_end, "bounds_element": index_checks.element,
}  # fmt: skip
"""Functions that the copies call. A task is unlikely to use their names."""


class Unchecked(Exception):  # noqa: N818
    """Raised if a function can't be checked."""


class CheckedFunctions:
    """Makes checked copies of functions, and a kernel for each copy.

    The report, (places, 3) int32, has a row for each index in the source: number of errors, first wrong index, size.
    """

    def __init__(self, module: str, functions: Mapping[str, wp.Function], views: Mapping[Any, wp.Function]) -> None:
        self._module, self._views = module, views
        self.places: list[str] = []
        """A message for each index in the source: "observe reads s.qpos[7] out of range (hopper.py, line 40)"."""
        self._numbers: dict[wp.Function, int] = {}
        self._copies: dict[int, wp.Function] = {}
        self._scopes: list[tuple[dict[str, Any], list[int]]] = []
        self.kernels = {name: self._kernel(name, function) for name, function in functions.items()}
        for scope, numbers in self._scopes:  # now that every copy exists, let the copies call one another
            scope |= {f"bounds_{number}": self._copies[number] for number in numbers}

    def load(self, device: wp.Device) -> None:
        """Compile the kernels, or raise Unchecked if Warp can't."""
        try:
            wp.get_module(self._module).load(device)
        except Exception as error:
            raise Unchecked(f"Warp can't compile the functions with checks: {' '.join(str(error).split())}") from error

    def report(self, device: wp.Device) -> wp.array:
        """Make an empty report."""
        return wp.zeros((max(len(self.places), 1), 3), dtype=int, device=device)

    def problems(self, report: wp.array) -> list[str]:
        """Describe the problems in a report, one per line."""
        found = []
        for place, (errors, index, size) in zip(self.places, report.numpy(), strict=False):
            there = f"there are {size} elements, 0 to {size - 1}" if size else "there are no elements"
            if errors:
                found.append(f"{place}: the index is {index}, and {there}")
        return list(dict.fromkeys(found))

    def place(self, source: FunctionSource, node: ast.AST, text: str, verb: str) -> int:
        """Add a row to the report, and return its index. The verb is "reads" or "writes"."""
        self.places.append(f"{source.name} {verb} {text} out of range ({source.place(node)})")
        return len(self.places) - 1

    def number(self, function: wp.Function) -> int:
        """Return the index of a function's copy, and create the copy on first use."""
        if function not in self._numbers:
            number = self._numbers[function] = len(self._numbers)
            for overload in overloads(function):
                self._copies[number] = self._copy(overload, number)
        return self._numbers[function]

    def _copy(self, function: wp.Function, number: int) -> wp.Function:
        try:
            source = FunctionSource(function)
        except ValueError as error:
            raise Unchecked(str(error)) from error
        rewriter = _Rewriter(self, source)
        tree = rewriter.visit(copy.deepcopy(source.tree))
        tree.name = f"checked_{number}_{source.name}"
        tree.decorator_list = [ast.parse("bounds_wp.func(module=bounds_module)", mode="eval").body]
        types = {f"bounds_type_{i}": kind for i, kind in enumerate(function.input_types.values())}
        for argument, name in zip(tree.args.args, types, strict=True):
            argument.annotation = ast.Name(name, ast.Load())
        tree.args.args.insert(0, ast.arg("bounds_report", ast.Name("bounds_report_type", ast.Load())))
        defaults = {
            f"bounds_default_{i}": value for i, value in enumerate(getattr(function.func, "__defaults__", None) or ())
        }
        tree.args.defaults = [ast.Name(name, ast.Load()) for name in defaults]
        returned = function.adj.arg_types.get("return")
        tree.returns = None if returned is None else ast.Name("bounds_result_type", ast.Load())
        types |= {"bounds_report_type": wp.array2d(dtype=int), "bounds_result_type": returned}
        scope = source.scope | _HELPERS | types | defaults
        scope |= {"bounds_wp": wp, "bounds_module": wp.get_module(self._module)}
        if number in self._copies:  # Warp treats a function with an existing key as an overload
            scope[tree.name] = self._copies[number]
        self._scopes.append((scope, rewriter.callees))
        self._run(ast.unparse(ast.fix_missing_locations(tree)), scope, len(self._scopes))
        copied: wp.Function = scope[tree.name]
        return copied

    def _run(self, text: str, scope: dict[str, Any], part: int | str) -> None:
        scope["__name__"] = self._module
        sources.run_source(text, f"<{self._module} {part}>", scope)

    def _kernel(self, name: str, function: wp.Function) -> wp.Kernel:
        number = self.number(function)
        scope: dict[str, Any] = {"wp": wp, "copy": self._copies[number]}
        arguments, lines, values = ["report: wp.array2d[int]"], ["w = wp.tid()"], ["report"]
        for i, kind in enumerate(function.input_types.values()):
            if view := self._views.get(kind):
                scope[f"view_{i}"], source = view, next(iter(view.input_types.values()))
                scope[f"type_{i}"] = wp.array2d(dtype=float) if is_row(source) else source
                values.append(f"view_{i}(values_{i}[w])" if is_row(source) else f"view_{i}(values_{i}, w)")
            else:
                scope[f"type_{i}"] = wp.array2d(dtype=kind.dtype) if is_row(kind) else wp.array(dtype=kind)
                values.append(f"values_{i}[w % values_{i}.shape[0]]")
            arguments.append(f"values_{i}: type_{i}")
        lines.append(f"copy({', '.join(values)})")
        text = f"def run_{name}({', '.join(arguments)}):\n" + "\n".join(f"    {line}" for line in lines) + "\n"
        self._run(text, scope, name)
        return wp.kernel(scope[f"run_{name}"], module=wp.get_module(self._module), enable_backward=False)


class _Rewriter(ast.NodeTransformer):
    def __init__(self, checked: CheckedFunctions, source: FunctionSource) -> None:
        self.checked, self.source = checked, source
        self.callees: list[int] = []
        self.writes = False

    def visit_AnnAssign(self, node: ast.AnnAssign) -> ast.AST:
        node.target = self.visit(node.target)
        node.value = node.value and self.visit(node.value)
        return node

    def visit_Name(self, node: ast.Name) -> ast.AST:
        return self._refused(node)

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        self._refused(node)
        node.value = self._visit(node.value, writes=self.writes or not isinstance(node.ctx, ast.Load))
        return node

    def _visit(self, node: ast.expr, *, writes: bool) -> ast.expr:
        kept, self.writes = self.writes, writes
        visited: ast.expr = self.visit(node)
        self.writes = kept
        return visited

    def _refused(self, node: ast.Name | ast.Attribute) -> ast.AST:
        """Refuse a function that the source uses as a value.

        The copy with index checks takes the report as an additional argument. Other code would not pass it.
        """
        function = self.source.value(node)
        if isinstance(function, wp.Function) and function.func is not None:
            raise Unchecked(
                f"{self.source.name} uses {name_of(function)} as a value ({self.source.place(node)}): call it instead"
            )
        return node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        kind, callee = self.source.call(node)
        if kind == "static":
            return node
        if callee is None and self.source.is_static(node.func):
            raise Unchecked(f"{self.source.name} calls a function chosen by a loop ({self.source.place(node)})")
        if kind == "native" and any(is_row(given) or is_struct(given) for given in callee.input_types.values()):
            raise Unchecked(
                f"{self.source.name} passes a row or a struct to the native function {name_of(callee)} "
                f"({self.source.place(node)}), and C++ code can't be checked: pass numbers instead"
            )
        if kind == "builtin" and callee.key.startswith("atomic_"):
            self._check_atomic(node, callee.key)
        node.args = [self.visit(argument) for argument in node.args]
        for keyword in node.keywords:
            keyword.value = self.visit(keyword.value)
        if kind == "helper":
            number = self.checked.number(callee)
            self.callees.append(number)
            node.func = _name(f"bounds_{number}")
            node.args.insert(0, _name("bounds_report"))
        elif kind != "native" and not isinstance(node.func, ast.Name):
            node.func = self.visit(node.func)
        return node

    def _check_atomic(self, node: ast.Call, key: str) -> None:
        text, values = ast.unparse(node), 2 if key == "atomic_cas" else 1
        row = self.visit(copy.deepcopy(node.args[0]))
        for axis, index in enumerate(node.args[1:-values]):
            node.args[1 + axis] = self._checked(node, text, "writes", row, axis, index)

    def visit_Subscript(self, node: ast.Subscript) -> ast.AST:
        if self._is_constant(node):
            return node
        writes = self.writes or not isinstance(node.ctx, ast.Load)
        text, verb = ast.unparse(node), "writes" if writes else "reads"
        called = any(isinstance(inner, ast.Call) for inner in ast.walk(node.value))
        base = self._visit(node.value, writes=writes)
        indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        if called and len(indices) == 1 and not isinstance(indices[0], ast.Slice) and verb == "reads":
            place = ast.Constant(self.checked.place(self.source, node, text, verb))
            index = self._visit(indices[0], writes=False)
            return _call("bounds_element", _name("bounds_report"), place, base, index)
        checked = [
            self._visit(index, writes=False)
            if isinstance(index, ast.Slice)
            else self._checked(node, text, verb, base, axis, self._visit(index, writes=False))
            for axis, index in enumerate(indices)
        ]
        node.value = base
        node.slice = ast.Tuple(checked, ast.Load()) if isinstance(node.slice, ast.Tuple) else checked[0]
        return node

    def _is_constant(self, node: ast.Subscript) -> bool:
        """Return whether Warp requires a constant index, as in a type, a tuple or a shape."""
        value = self.source.value(node.value)
        type_or_tuple = value is not None and not hasattr(value, "_wp_scalar_type_")
        return type_or_tuple or (isinstance(node.value, ast.Attribute) and node.value.attr in _SHAPES)

    def _checked(self, node: ast.AST, text: str, verb: str, base: ast.expr, axis: int, index: ast.expr) -> ast.expr:
        place = ast.Constant(self.checked.place(self.source, node, text, verb))
        for _ in range(axis):
            base = ast.Subscript(_loaded(base), ast.Constant(0), ast.Load())
        negative = isinstance(index, ast.UnaryOp) and isinstance(index.op, ast.USub)
        constant = negative and isinstance(index.operand, ast.Constant)  # type: ignore[attr-defined]
        size = _call("len", _loaded(base))
        return _call("bounds_from_end" if constant else "bounds_at", _name("bounds_report"), place, index, size)


def _name(name: str) -> ast.Name:
    return ast.Name(name, ast.Load())


def _call(name: str, *arguments: ast.expr) -> ast.Call:
    return ast.Call(_name(name), list(arguments), [])


def _loaded(node: ast.expr) -> ast.expr:
    loaded = copy.deepcopy(node)
    if isinstance(loaded, ast.Attribute | ast.Subscript | ast.Name):
        loaded.ctx = ast.Load()
    return loaded


_made: dict[Any, CheckedFunctions] = {}


def checked_functions(
    name: str, functions: Mapping[str, wp.Function], views: Mapping[Any, wp.Function], device: wp.Device
) -> CheckedFunctions:
    """Get checked copies of a task's functions, compiled for a device."""
    key = (*views.values(), *functions.items())
    if key not in _made:
        module = sources.free_module_name(f"lyceum_warp.checked.{name}")
        _made[key] = CheckedFunctions(module, functions, views)
    _made[key].load(device)
    return _made[key]
