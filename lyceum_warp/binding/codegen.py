"""Generate the source of a task's kernels, which call the task's functions for every world of a batch.

The source defines a struct with the fields of all worlds, and a function that returns a view of one world. It is
generated as text, because Warp compiles functions from their source.
"""

import dataclasses
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from lyceum_warp.binding.functions import TaskSource, draws_noise
from lyceum_warp.binding.parts import Layout, view_lines
from lyceum_warp.binding.sources import free_module_name, is_struct, run_source
from lyceum_warp.binding.writes import written_fields
from lyceum_warp.core.fields import is_data_field
from lyceum_warp.core.model_fields import NOT_NEGATIVE
from lyceum_warp.core.task import FUNCTIONS, Row, TaskFunction
from lyceum_warp.kernels import random, rows as kernel_rows, task_kernels
from lyceum_warp.kernels.step_types import Counters, TaskCode

_BATCH = """
@wp.struct
class Batch:
{batch}


@wp.func
def view(batch: Batch, w: int) -> World:
    s = World()
{rows}
    return s


@wp.func
def copy_state(source: Batch, target: Batch, w: int, lane: int, lanes: int):
{state}


@wp.struct
class Observations:
{groups}


@wp.func
def observe_group(group: int, s: World, p: Params, out: Observations, w: int, counters: Counters):
{observe}


@wp.func
def valid_group(group: int, out: Observations, w: int) -> bool:
    valid = bool(True)
{valid}
    return valid


@wp.func
def copy_observations(source: Observations, target: Observations, w: int, lane: int, lanes: int):
{copy}


@wp.func
def finite_memory(before: Batch, after: Batch, w: int, lane: int, lanes: int) -> bool:
    finite = bool(True)
{memory}
    return finite


@wp.func
def valid_model(s: World, lane: int, lanes: int) -> bool:
    valid = bool(True)
{model}
    return valid
"""

_ROW_VIEW = """
@wp.func
def view_{name}(row: Row[float]) -> Struct_{name}:
    struct_{name} = Struct_{name}()
{lines}
    return struct_{name}

"""

_MEMORY_CHECKS = {
    "memory": "    if not finite_row(after.memory[w], lane, lanes):\n        finite = False",
    "lasting_memory":
        "    if not restored_row(before.lasting_memory[w], after.lasting_memory[w], lane, lanes):\n"
        "        finite = False",
}  # fmt: skip
"""Warp source that checks each kind of memory for non-finite numbers. In ``lasting_memory``, it also replaces these
numbers by the numbers before the step."""

_OBSERVE = wp.constant(-1)
"""Number of the substream from which observation noise is drawn."""

_kernels: dict[Any, task_kernels.Kernels] = {}
_MAKING = threading.RLock()


def kernels_of(
    source: TaskSource,
    groups: Mapping[str, wp.Function],
    memory: Mapping[str, Layout],
    structs: Mapping[str, Layout],
) -> task_kernels.Kernels:
    """Return a task's kernels. Tasks with the same functions, structs and sizes share their kernels."""
    layouts = tuple((name, *layout.items()) for name, layout in (*memory.items(), *structs.items()))
    called = tuple(source.terms.functions.items())
    key = (
        source.world, source.params, tuple(source.functions.values()), tuple(groups.items()), layouts,
        source.terms.text, called,
    )  # fmt: skip
    with _MAKING:
        if key not in _kernels:
            scope = _generated(source, groups, memory, structs)
            scope["terms"] = source.terms.generated(f"<lyceum_warp {source.path} terms>")
            found = dict(source.functions)
            found |= {name: scope["terms"].get(name, found[name]) for name in ("terminated", "truncated")}
            functions = {name: function or scope.get(f"no_{name}") for name, function in found.items()}
            written = [name for name, function in found.items() if function is not None]
            module = free_module_name(f"lyceum_warp.generated.{source.kernel_name}")
            given: dict[str, Any] = {"module": module, "functions": functions, "written": written}
            names = [field.name for field in dataclasses.fields(TaskCode) if field.init and field.name not in given]
            _kernels[key] = task_kernels.make_kernels(TaskCode(**given, **{name: scope[name] for name in names}))
        return _kernels[key]


def _generated(
    source: TaskSource,
    groups: Mapping[str, wp.Function],
    memory: Mapping[str, Layout],
    structs: Mapping[str, Layout],
) -> dict[str, Any]:
    """Run the generated source, and return the structs, wrappers and default functions that it defines."""
    scope: dict[str, Any] = {"wp": wp, "Row": Row, "World": source.world, "Params": source.params}
    scope |= {"Shared": source.shared, "Sums": source.sums}
    batch, rows, state, views = [], [], [], []

    def view_row(name: str, struct: Any) -> None:
        scope[f"Struct_{name}"] = struct
        lines = view_lines(structs[name], f"struct_{name}", "row", scope)
        views.append(_ROW_VIEW.format(name=name, lines="\n".join(f"    {line}" for line in lines)))

    if source.shared is not None:
        view_row("Shared", source.shared)
        view_row("Sums", source.sums)
        scope["type_shared"] = wp.array2d(dtype=float)
        batch.append("    shared: type_shared")
        rows.append("s.shared = view_Shared(batch.shared[0])")
    fields = {name: variable.type for name, variable in source.world.vars.items()
              if name not in source.memory and not is_struct(variable.type)}  # fmt: skip
    fields |= {name: Row[float] for name, layout in memory.items() if layout}
    for name, kind in fields.items():
        ndim, dtype = (kind.ndim + 1, kind.dtype) if hasattr(kind, "ndim") else (1, kind)
        scope[f"type_{name}"] = wp.array(dtype=dtype, ndim=ndim)
        batch.append(f"    {name}: type_{name}")
        if name in memory:
            rows += [f"{name} = batch.{name}[w]", *view_lines(memory[name], "s", name, scope)]
        else:
            rows.append(f"s.{name} = batch.{name}[w]")
        if name in memory or is_data_field(name):  # model fields are not copied, because a step does not change them
            state += _copy(name, ndim)
    scope |= {"stream": random.stream, "substream": random.substream, "OBSERVE": _OBSERVE, "Counters": Counters}
    scope |= {"finite_row": kernel_rows.finite_row, "copy_row": kernel_rows.copy_row}
    scope |= {"restored_row": kernel_rows.restored_row, "row_in_range": kernel_rows.row_in_range}
    observe = []
    if any(map(draws_noise, groups.values())):  # the noise of a group depends only on the counters
        observe.append("base = substream(stream(counters.key[w], counters.episode[w], counters.step[w]), OBSERVE)")
        observe.append("rng = counters.rng[group * counters.step.shape[0] + w]")
    for number, (group, function) in enumerate(groups.items()):
        scope[f"observe_{number}"] = function
        noisy = draws_noise(function)
        observe.append(f"if group == {number}:")
        if noisy:  # each group has its own random stream, so its noise does not depend on the other groups
            observe.append(f"    rng[0] = substream(base, {number})")
        row = f"out.{group}[w]"
        if group in structs:
            view_row(group, list(function.input_types.values())[2])
            row = f"view_{group}({row})"
        observe.append(f"    observe_{number}(s, p, {row}{', rng' if noisy else ''})")
    blocks = {
        "batch": batch,
        "rows": [f"    {line}" for line in rows],
        "state": state or ["    pass"],
        "groups": [f"    {group}: type_group" for group in groups],
        "observe": [f"    {line}" for line in observe],
        "valid": [
            f"    if group == {number}:\n        valid = row_in_range(out.{group}[w], 0, 1)"
            for number, group in enumerate(groups)
        ],
        "copy": [f"    copy_row(source.{group}[w], target.{group}[w], lane, lanes)" for group in groups],
    }
    blocks["memory"] = [line for name, line in _MEMORY_CHECKS.items() if name in fields]
    blocks["model"] = _model_checks(source)
    scope["type_group"] = wp.array2d(dtype=float)
    scope |= {"has_memory": bool(blocks["memory"]), "checks_model": bool(blocks["model"]), "has_state": bool(state)}
    parts = [_BATCH.format(**{name: "\n".join(lines) for name, lines in blocks.items()})]
    parts += [_default(function) for function in FUNCTIONS.values() if function.default is not None]
    text = "\n".join([*views, *parts])
    scope["__name__"] = f"lyceum_warp.generated.{source.name}"
    run_source(text, f"<lyceum_warp {source.path}>", scope)
    scope["views"] = {source.world: scope["view"]} | {scope[f"Struct_{x}"]: scope[f"view_{x}"] for x in structs}
    return scope


def _copy(name: str, ndim: int) -> list[str]:
    """Generate lines that copy one world's row of a field. Each thread copies a part of the row."""
    if ndim == 1:
        return ["    if lane == 0:", f"        target.{name}[w] = source.{name}[w]"]
    lines = [f"    for i1 in range(lane, source.{name}.shape[1], lanes):"]
    for axis in range(2, ndim):
        lines.append("    " * axis + f"for i{axis} in range(source.{name}.shape[{axis}]):")
    place = ", ".join(["w", *(f"i{axis}" for axis in range(1, ndim))])
    return [*lines, "    " * ndim + f"target.{name}[{place}] = source.{name}[{place}]"]


def _model_checks(source: TaskSource) -> list[str]:
    """Generate lines that detect NaN and invalid negative numbers in the model fields that the task writes."""
    written = frozenset[str]().union(*(written_fields(function) for function in source.functions.values() if function))
    lines = []
    for name, variable in source.world.vars.items():
        if name in written & NOT_NEGATIVE:
            size = int(np.prod(getattr(variable.type.dtype, "_shape_", ()), dtype=int))
            elements = (
                [f"s.{name}[i]"] if variable.type.dtype is wp.float32 else [f"s.{name}[i][{j}]" for j in range(size)]
            )
            bad = " or ".join(f"not ({element} >= 0.0)" for element in elements)
            lines.append(f"    for i in range(lane, s.{name}.shape[0], lanes):")
            lines += [f"        if {bad}:", "            valid = False"]
    return lines


def _default(function: TaskFunction) -> str:
    return f"\n\n@wp.func\ndef no_{function.signature}:\n    {function.default}\n"
