"""Generate the source of a task's kernels, which call the task's functions for every world of a batch.

The source defines a struct with the fields of all worlds, and a function that returns a view of one world. It is
generated as text, because Warp compiles functions from their source.
"""

import dataclasses
import threading
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from lyceum_warp.binding.functions import TaskSource, draws_noise
from lyceum_warp.binding.layouts import Layouts
from lyceum_warp.binding.parts import view_lines
from lyceum_warp.binding.registry import kernel_name
from lyceum_warp.binding.sources import free_module_name, run_source
from lyceum_warp.core.fields import is_data_field
from lyceum_warp.core.model_fields import NOT_NEGATIVE
from lyceum_warp.core.task import FUNCTIONS, Row
from lyceum_warp.kernels import faults, random, rows as kernel_rows, task_kernels
from lyceum_warp.kernels.step_types import Counters, TaskCode
from lyceum_warp.support.upstream import refuse_integer_divisions

_MODULE = "lyceum_warp.generated."
"""Prefix of the names of the generated modules."""

refuse_integer_divisions(_MODULE)

_HELPERS: dict[str, Any] = {
    "wp": wp, "Row": Row, "Counters": Counters, "stream": random.stream, "substream": random.substream,
    "finite_row": kernel_rows.finite_row, "copy_row": kernel_rows.copy_row, "restored_row": kernel_rows.restored_row,
    "row_in_range": faults.row_in_range,
    "OBSERVE": wp.constant(-1),  # number of the substream from which observation noise is drawn
    "type_row": wp.array2d(dtype=float),
}  # fmt: skip
"""Names in the scope of the generated source."""

_kernels: dict[Any, task_kernels.Kernels] = {}
_MAKING = threading.RLock()


def kernels_of(source: TaskSource, layouts: Layouts) -> task_kernels.Kernels:
    """Return a task's kernels. Tasks with the same functions, structs and sizes share their kernels."""
    rows = tuple((name, *layout.items()) for name, layout in (*layouts.memory.items(), *layouts.structs.items()))
    terms = (source.terms.text, *source.terms.functions.items())
    key = (source.world, source.params, *source.functions.values(), *layouts.observers.items(), rows, terms)
    with _MAKING:
        if key not in _kernels:
            scope = _Generator(source, layouts).run()
            names = [field.name for field in dataclasses.fields(TaskCode) if field.name in scope]
            _kernels[key] = task_kernels.make_kernels(TaskCode(**{name: scope[name] for name in names}))
        return _kernels[key]


class _Generator:
    """Generates the source of the structs and functions that a task's kernels use, and runs it.

    Args:
        source: The task's structs and functions.
        layouts: The layouts of memory and observations.
    """

    def __init__(self, source: TaskSource, layouts: Layouts) -> None:
        self._source, self._groups = source, layouts.observers
        self._memory, self._structs = layouts.memory, layouts.structs
        self._texts: list[str] = []
        self._scope = _HELPERS | {"World": source.world, "Params": source.params}
        self._scope |= source.shared_structs

    def run(self) -> dict[str, Any]:
        """Return the fields of ``TaskCode`` by name, among other names."""
        source, scope, task = self._source, self._scope, self._source.definition
        name, path = kernel_name(task), f"{task.__module__}.{task.__qualname__}"
        self._row_views()
        self._batch()
        self._observations()
        self._memory_check()
        self._model_check()
        for form in FUNCTIONS.values():
            if form.default is not None:
                self._function(f"no_{form.signature}", [form.default])
        scope["__name__"] = f"{_MODULE}{name}"
        run_source("\n\n".join(self._texts), f"<lyceum_warp {path}>", scope)
        terms = source.terms.generated(f"{_MODULE}terms.{name}", f"<lyceum_warp {path} terms>")
        functions = source.functions | {name: terms[name] for name in source.terms.combined}
        return scope | {
            "module": free_module_name(f"{_MODULE}{name}"),
            "functions": SimpleNamespace(**{name: f or scope.get(f"no_{name}") for name, f in functions.items()}),
            "written": [name for name, function in functions.items() if function is not None],
            "terms": SimpleNamespace(**terms),
        }

    def _struct(self, name: str, fields: Iterable[str]) -> None:
        self._texts.append("\n".join(["@wp.struct", f"class {name}:", *(f"    {field}" for field in fields)]))

    def _function(self, signature: str, lines: Iterable[str]) -> None:
        self._texts.append("\n".join(["@wp.func", f"def {signature}:", *(f"    {line}" for line in lines)]))

    def _row_views(self) -> None:
        """Generate functions that return a struct whose fields are slices of a row."""
        structs = self._source.shared_structs | {
            group: list(function.input_types.values())[2] for group, function in self._groups.items()
        }
        for name, layout in self._structs.items():
            self._scope[f"Struct_{name}"] = structs[name]
            lines = view_lines(layout, f"struct_{name}", "row", self._scope)
            self._function(
                f"view_{name}(row: Row[float]) -> Struct_{name}",
                [f"struct_{name} = Struct_{name}()", *lines, f"return struct_{name}"],
            )

    def _batch(self) -> None:
        """Generate the structs of all worlds' fields, the view of one world, and the copy of a world's state."""
        fields: list[str] = []
        rows: list[str] = []
        copies: list[str] = []
        if self._source.shared_structs:
            fields.append("shared: type_row")
            rows.append("s.shared = view_Shared(batch.shared[0])")
        for name, kind in self._source.types.items():
            ndim, dtype = (kind.ndim + 1, kind.dtype) if hasattr(kind, "ndim") else (1, kind)
            self._scope[f"type_{name}"] = wp.array(dtype=dtype, ndim=ndim)
            fields.append(f"{name}: type_{name}")
            if name in self._memory:
                rows += [f"{name} = batch.{name}[w]", *view_lines(self._memory[name], "s", name, self._scope)]
            else:
                rows.append(f"s.{name} = batch.{name}[w]")
            if name in self._memory or is_data_field(name):  # a step does not change model fields
                copies += _copy(name, ndim)
        self._struct("Batch", fields)
        self._function("view(batch: Batch, w: int) -> World", ["s = World()", *rows, "return s"])
        self._scope["type_params"] = wp.array(dtype=self._source.params)
        arrays = ["params: type_params", "weights: type_row", "action: type_row", "counters: Counters"]
        self._struct("Transition", ["before: Batch", "after: Batch", *arrays])
        self._function("params_of(t: Transition, w: int) -> Params", ["return t.params[w % t.params.shape[0]]"])
        if copies:
            self._function("copy_state(source: Batch, target: Batch, w: int, lane: int, lanes: int)", copies)

    def _observations(self) -> None:
        """Generate the struct of all observation groups, and functions that write and copy groups."""
        self._struct("Observations", [f"{group}: type_row" for group in self._groups])
        lines = ["valid = bool(True)"]
        if any(map(draws_noise, self._groups.values())):  # the noise of a group depends only on the counters
            lines.append("base = substream(stream(counters.key[w], counters.episode[w], counters.step[w]), OBSERVE)")
            lines.append("rng = counters.rng[group * counters.step.shape[0] + w]")
        for number, (group, function) in enumerate(self._groups.items()):
            self._scope[f"observe_{number}"] = function
            row = f"view_{group}(out.{group}[w])" if group in self._structs else f"out.{group}[w]"
            lines.append(f"if group == {number}:")
            if draws_noise(function):  # the stream of a group does not depend on the other groups
                lines.append(f"    rng[0] = substream(base, {number})")
                lines.append(f"    observe_{number}(s, p, {row}, rng)")
            else:
                lines.append(f"    observe_{number}(s, p, {row})")
            lines.append(f"    valid = row_in_range(out.{group}[w], 0, 1)")
        arguments = "group: int, s: World, p: Params, out: Observations, w: int, counters: Counters"
        self._function(f"observe_group({arguments}) -> bool", [*lines, "return valid"])
        copies = [f"copy_row(source.{group}[w], target.{group}[w], lane, lanes)" for group in self._groups]
        arguments = "source: Observations, target: Observations, w: int, lane: int, lanes: int"
        self._function(f"copy_observations({arguments})", copies)

    def _memory_check(self) -> None:
        """Generate a function that finds non-finite numbers in memory, and undoes them in lasting memory."""
        checks = {
            "memory": "finite_row(after.memory[w], lane, lanes)",
            "lasting_memory": "restored_row(before.lasting_memory[w], after.lasting_memory[w], lane, lanes)",
        }
        lines = [
            line for name, check in checks.items() if name in self._source.types
            for line in (f"if not {check}:", "    finite = False")
        ]  # fmt: skip
        if lines:
            arguments = "before: Batch, after: Batch, w: int, lane: int, lanes: int"
            self._function(f"finite_memory({arguments}) -> bool", ["finite = bool(True)", *lines, "return finite"])

    def _model_check(self) -> None:
        """Generate a function that finds NaN and invalid negative numbers in the model fields that the task writes."""
        written = frozenset[str]().union(*self._source.written.values())
        lines = []
        for name, kind in self._source.types.items():
            if name in written & NOT_NEGATIVE:
                size = int(np.prod(getattr(kind.dtype, "_shape_", ()), dtype=int))
                scalar = kind.dtype is wp.float32
                elements = [f"s.{name}[i]" if scalar else f"s.{name}[i][{j}]" for j in range(size)]
                lines.append(f"for i in range(lane, s.{name}.shape[0], lanes):")
                lines.append(f"    if {' or '.join(f'not ({element} >= 0.0)' for element in elements)}:")
                lines.append("        valid = False")
        if lines:
            lines = ["valid = bool(True)", *lines, "return valid"]
            self._function("valid_model(s: World, lane: int, lanes: int) -> bool", lines)


def _copy(name: str, ndim: int) -> list[str]:
    """Generate lines that copy one world's row of a field. Each thread copies a part of the row."""
    if ndim == 1:
        return ["if lane == 0:", f"    target.{name}[w] = source.{name}[w]"]
    lines = [f"for i1 in range(lane, source.{name}.shape[1], lanes):"]
    for axis in range(2, ndim):
        lines.append("    " * (axis - 1) + f"for i{axis} in range(source.{name}.shape[{axis}]):")
    place = ", ".join(["w", *(f"i{axis}" for axis in range(1, ndim))])
    return [*lines, "    " * (ndim - 1) + f"target.{name}[{place}] = source.{name}[{place}]"]
