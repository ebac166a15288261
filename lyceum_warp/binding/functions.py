"""Find a task's structs and functions in its class or module, and check them against ``task.FUNCTIONS``."""

import ast
import dataclasses
import difflib
import functools
import sys
from collections.abc import Callable, Collection, Mapping
from typing import Any

import warp as wp

from lyceum_warp.binding.parts import parts_of
from lyceum_warp.binding.registry import kernel_name
from lyceum_warp.binding.sources import is_struct, source_of
from lyceum_warp.binding.task_terms import Terms
from lyceum_warp.binding.variants import Variant, check_structs, merged, variant_of
from lyceum_warp.core.task import FUNCTIONS, GROUP_PREFIX, MEMORIES, Part, Task, TaskFunction, observer_name


class TaskSource:
    """Finds the structs and the functions of a task."""

    def __init__(self, task: type[Task], name: str) -> None:
        self.definition, self.name = task, name
        self.path = f"{task.__module__}.{task.__qualname__}"
        self.kernel_name = kernel_name(task)
        self._owners: Any = task.__mro__[: task.__mro__.index(Task)]
        self._variant: Variant | None = None
        self.world: Any = self._struct("World")
        own: Any = self._struct("Params")
        self.defaults: type = own.cls
        self.params: Any = self._with_functions(own)
        self._variant = variant_of(name, self._owners, self.world, self.params, own)
        self.memory: dict[str, Part] = self._memory()
        self.shared, self.sums = self._shared_structs()
        self.functions: dict[str, wp.Function | None] = {
            name: self._function(wanted) for name, wanted in FUNCTIONS.items()
        }
        term = functools.partial(self._written, accepts=lambda f: isinstance(f, wp.Function) and f.func is not None)
        self.terms = Terms(task, name, term, self.functions, self.world, self.params)
        if self.functions["observe"] is None:
            raise ValueError(f"the task {self.name!r} has no observe(s, p, obs), which every task needs")
        self._check_names()

    def group_functions(self, groups: Collection[str]) -> dict[str, wp.Function]:
        """Return the functions that write observation groups, by group name."""
        found = {}
        for group in groups:
            wanted = dataclasses.replace(FUNCTIONS["observe"], name=observer_name(group))
            function = self._function(wanted)
            if function is None:
                raise ValueError(
                    f"no function of the task {self.name!r} writes the group {group!r} of its observations: add "
                    f"{wanted.signature}"
                )
            found[group] = function
        for name in self._observers(self.definition):
            if (group := name.removeprefix(GROUP_PREFIX)) not in groups:
                raise ValueError(f"obs of the task {self.name!r} has no group {group!r}, which {name} writes")
        return found

    def group_structs(self) -> dict[str, Any]:
        """Return the structs into which functions write observation groups, by group name."""
        names = [name for owner in reversed(self._owners) for name in self._observers(owner)]
        groups = dict.fromkeys(["policy", *(name.removeprefix(GROUP_PREFIX) for name in names)])
        functions = self.group_functions(groups)
        return {group: list(function.input_types.values())[2] for group, function in functions.items()}

    def _observers(self, owner: type[Task]) -> list[str]:
        """Find the functions that write observation groups, in the class and in its module.

        Functions of the module are left out if another function calls them.
        """
        module = vars(sys.modules[owner.__module__])
        written = {name: value for name, value in module.items() if isinstance(value, wp.Function)}
        functions = {name: self._seen(value) for name, value in written.items()}
        tasks = [kind for kind in (owner, *module.values()) if isinstance(kind, type) and issubclass(kind, Task)]
        used = {id(self._seen(value)) for task in tasks for value in vars(task).values()}
        called = {name for f in written.values() if f.func is not None for name in f.func.__code__.co_names}
        forms = (FUNCTIONS["observe"].kinds, FUNCTIONS["observe"].all_kinds)
        own = [name for name, value in vars(owner).items() if isinstance(value, wp.Function | staticmethod)]
        unused = [
            name
            for name, function in functions.items()
            if name not in called and id(function) not in used
            and tuple(map(self._kind, function.input_types.values())) in forms  # ignore other tasks' functions
            and (self._has_structs or not any(_may_list(task, name.removeprefix(GROUP_PREFIX)) for task in tasks))
        ]  # fmt: skip
        return [name for name in (*own, *unused) if name.startswith(GROUP_PREFIX)]

    def _written(self, name: str, accepts: Callable[[Any], bool] = lambda found: found is not None) -> Any:
        """Look up a name in the class, in its module, and in the base classes and their modules."""
        for owner in self._owners:
            for names in (vars(owner), owner.scope, vars(sys.modules[owner.__module__])):
                found = names.get(name)
                found = found.__func__ if isinstance(found, staticmethod) else found
                if accepts(found):
                    return self._seen(found)
        return None

    def _seen(self, value: Any) -> Any:
        """Return the task's copy of a struct or function; see ``variants``."""
        return value if self._variant is None else self._variant.seen(value)

    @property
    def _has_structs(self) -> bool:
        return not hasattr(self.definition, "obs")

    def _struct(self, name: str) -> Any:
        struct = self._declared(name, self.definition)
        if isinstance(struct, type):
            raise ValueError(f"{name} of the task {self.name!r} must be a Warp struct: decorate it with @wp.struct")
        if not hasattr(struct, "vars"):
            raise ValueError(f"the task {self.name!r} needs a @wp.struct named {name} in its module")
        return struct

    def _declared(self, name: str, owner: type[Task]) -> Any:
        """Return the struct that a class declares, merged with those of the parents if it extends one of them."""
        scopes = (vars(owner), owner.scope, vars(sys.modules[owner.__module__]))
        own = next((scope[name] for scope in scopes if name in scope), None)
        parents = [self._declared(name, base) for base in owner.__bases__ if base in self._owners]
        structs = list(filter(is_struct, parents))
        if own is None:
            return merged(structs) if structs else None
        extends = is_struct(own) and any(issubclass(own.cls, struct.cls) for struct in structs)
        return merged([own, *structs]) if extends else own

    def _with_functions(self, own: Any) -> Any:
        """Return the parameter struct that functions take.

        A task that changes only defaults uses the struct of its base task, to share functions and kernels with it.
        """
        fields = {name: wp.types.type_repr(field.type) for name, field in own.vars.items()}
        for owner in reversed(self._owners):
            struct = vars(owner).get("Params", owner.scope.get("Params"))
            known = struct.vars.items() if is_struct(struct) and issubclass(own.cls, struct.cls) else ()
            if {name: wp.types.type_repr(field.type) for name, field in known} == fields:
                return struct
        return own

    def _memory(self) -> dict[str, Part]:
        counted = [name for name in MEMORIES if hasattr(self.definition, name)]
        parts = parts_of(self.world, "World")
        if old := [*counted, *(name for name in MEMORIES if name in self.world.vars and name not in parts)]:
            raise ValueError(
                f"{old[0]} of the task {self.name!r} is a row without named parts: declare each part in World, for "
                f"example air_time: Row[float] = lw.{old[0]}(4)"
            )
        if wrong := [name for name, part in parts.items() if part.kind not in MEMORIES]:
            raise ValueError(
                f"World.{wrong[0]} of the task {self.name!r} is declared by lw.part(...): use lw.memory(...)"
            )
        return parts

    def _shared_structs(self) -> tuple[Any, Any]:
        field, tally, share = self.world.vars.get("shared"), self._written("tally"), self._written("share")
        if field is None and tally is None and share is None:
            return None, None
        structs = [list(function.input_types.values())[i] for function, i in ((tally, 5), (share, 1))
                   if isinstance(function, wp.Function) and len(function.input_types) > i]  # fmt: skip
        if field is None or not is_struct(field.type) or len(structs) < 2 or structs[0] is not structs[1]:
            raise ValueError(
                f"the task {self.name!r} lacks a part of shared memory: it needs the structs Shared and Sums, a field "
                f"World.shared of the type Shared, and the functions {FUNCTIONS['tally'].signature} and "
                f"{FUNCTIONS['share'].signature}"
            )
        return field.type, structs[0]

    def _function(self, wanted: TaskFunction) -> wp.Function | None:
        name = wanted.name
        function = self._written(name)
        if function is None:
            return None
        if not isinstance(function, wp.Function):
            raise ValueError(f"{name} of the task {self.name!r} must be a @wp.func, not {function!r}")
        types = list(function.input_types.values())
        structs = [kind for kind in types if is_struct(kind)]
        foreign = structs and self.world not in structs and self.params not in structs
        if foreign and function.func.__module__ in {owner.__module__ for owner in self.definition.__mro__}:
            return None  # the function belongs to another task in the module
        annotations = function.func.__annotations__
        if any(isinstance(annotation, str) for annotation in annotations.values()):
            raise ValueError(
                f"{name} of the task {self.name!r} has annotations that are text, not types: remove "
                "'from __future__ import annotations' and quotes around types"
            )
        returned = annotations.get("return")
        values = _return_values(function)
        if wanted.result is not None and not values:
            raise ValueError(f"{name} of the task {self.name!r} has no return: write it as {wanted.signature}")
        if wanted.result is not None and any(isinstance(value, ast.Tuple) for value in values):
            raise ValueError(
                f"{name} of the task {self.name!r} returns a tuple, but must return a single {wanted.result.__name__}"
            )
        check_structs(self.name, function, {self.world: self.world.cls, self.params: self.defaults})
        kinds = tuple(map(self._kind, types))
        if kinds not in (wanted.kinds, wanted.all_kinds) or (returned is not None and returned is not wanted.result):
            more = f", with or without a last argument {wanted.optional}" if wanted.optional else ""
            if wanted.name.startswith("observe") and len(structs) == 3:
                more = f"{more}; to write the struct {structs[2].key}, remove obs from the class"
            raise ValueError(f"{name} of the task {self.name!r} must be written as {wanted.signature}{more}")
        return function

    def _kind(self, argument: Any) -> str:
        """Return an argument's type as ``FUNCTIONS`` writes it, such as "World" or "Row[float]"."""
        if argument is self.world:
            return "World"
        if argument is self.params:
            return "Params"
        if argument is not None and argument in (self.shared, self.sums):
            return "Shared" if argument is self.shared else "Sums"
        if self._has_structs and is_struct(argument):
            return "Row[float]"
        element: Any = getattr(argument, "dtype", None) if getattr(argument, "ndim", 0) == 1 else None
        kinds = {wp.float32: "Row[float]", wp.uint32: "Row[wp.uint32]"}
        return "bool" if argument in (bool, wp.bool) else kinds.get(element, "?")

    def _check_names(self) -> None:
        """Refuse a name that is similar to one in ``FUNCTIONS``, because it is probably misspelt."""
        attributes = [name for name in vars(Task) if not name.startswith("_")]
        for name in vars(self.definition):
            if name.startswith(("_", GROUP_PREFIX)) or name in (*attributes, "World", "Params", *FUNCTIONS):
                continue
            if close := difflib.get_close_matches(name, (*attributes, *FUNCTIONS), 1, 0.75):
                raise ValueError(f"the task {self.name!r} has {name!r} in its class: did you mean {close[0]}?")
        for name, value in vars(sys.modules[self.definition.__module__]).items():
            known = (*FUNCTIONS, *self.terms.functions)
            if isinstance(value, wp.Function) and name not in known and not name.startswith(GROUP_PREFIX):
                own = self._kind(next(iter(value.input_types.values()), None)) == "World"
                close = difflib.get_close_matches(name, [f for f in FUNCTIONS if self.functions[f] is None], 1, 0.85)
                if own and close:
                    raise ValueError(f"the task {self.name!r} has a function {name!r}: did you mean {close[0]}?")


def draws_noise(observer: wp.Function) -> bool:
    """Whether the function of an observation group takes a random stream."""
    return len(observer.input_types) > len(FUNCTIONS["observe"].kinds)


def _may_list(task: type[Task], group: str) -> bool:
    """Whether the ``obs`` of a task may have the given group."""
    obs = getattr(task, "obs", None)
    return callable(obs) or (isinstance(obs, Mapping) and isinstance(obs.get(group), Mapping))


def _return_values(function: wp.Function) -> list[ast.expr]:
    nodes = ast.walk(source_of(function).tree)
    return [node.value for node in nodes if isinstance(node, ast.Return) and node.value is not None]
