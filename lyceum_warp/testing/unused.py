"""Find the unused parts of a task: functions that are never called, and memory that is never read."""

import ast
import sys
from typing import Any

import warp as wp

from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.binding.sources import FunctionSource, has_source, overloads
from lyceum_warp.task import FUNCTIONS, GROUP_PREFIX, Task


def unused(task: BoundTask) -> list[str]:
    """List functions that are never called and memory that is never read, one per line."""
    return [*_functions(task), *_memory(task)]


def _functions(task: BoundTask) -> list[str]:
    module = vars(sys.modules[task.task.__module__])
    own = {name: value for name, value in module.items() if isinstance(value, wp.Function) and has_source(value)}
    used = {*FUNCTIONS, *task.source.terms.functions}
    for function in own.values():
        for overload in overloads(function):
            code: Any = overload.func
            used |= {*code.__code__.co_names, *overload.input_types}
    for kind in module.values():
        if isinstance(kind, type) and issubclass(kind, Task):
            used |= {*kind.rewards, *kind.terminations, *kind.metrics}
            used |= {name for name, value in own.items() if value in vars(kind).values()}
    return [
        f"{name} is never called: list it in rewards, terminations or metrics, call it, or remove it"
        for name, function in own.items()
        if name not in used
        and not hasattr(function, "replaces")
        and function.func.__module__ == task.task.__module__
        and not name.startswith(GROUP_PREFIX)
    ]


def _memory(task: BoundTask) -> list[str]:
    roots = (*task.functions.values(), *task.observers.values(), *task.kernels.terms.values())
    waiting: list[Any] = [overload for root in roots if root is not None for overload in overloads(root)]
    seen, read = set[wp.Function](), set[str]()
    while waiting:
        function = waiting.pop()
        if function in seen or not has_source(function):
            continue
        seen.add(function)
        source = FunctionSource(function)
        nodes = list(ast.walk(source.tree))
        written = {id(n.value) for n in nodes if isinstance(n, ast.Subscript) and isinstance(n.ctx, ast.Store)}
        read |= {n.attr for n in nodes if isinstance(n, ast.Attribute) and id(n) not in written}
        calls = [source.call(node) for node in nodes if isinstance(node, ast.Call)]
        waiting += [overload for kind, callee in calls if kind == "helper" for overload in overloads(callee)]
    return [f"World.{name} is never read: remove it" for name in task.source.memory if name not in read]
