"""Read a task's class and modules: its structs, functions, terms and memory."""

import ast
import dataclasses
import functools
import sys
from collections.abc import Callable, Collection, Mapping
from typing import Any

import warp as wp

from lyceum_warp.binding.parts import parts_of
from lyceum_warp.binding.sources import is_struct, overloads, source_of
from lyceum_warp.binding.task_terms import Terms
from lyceum_warp.binding.variants import Variant, check_structs, merged, variant_of
from lyceum_warp.binding.writes import Rights, check_reads, check_writes, written_fields
from lyceum_warp.core.fields import INITIAL, INPUTS, is_data_field
from lyceum_warp.core.model_fields import is_model_field
from lyceum_warp.core.spaces import OWN_PARTS
from lyceum_warp.core.task import (
    FUNCTIONS,
    GROUP_PREFIX,
    MEMORIES,
    RESULTS,
    Part,
    Row,
    Task,
    TaskFunction,
    observer_name,
)

_BEFORE_FORWARD = {"startup", "initialize", "randomize"}
"""Functions that run before the engine computes the fields of the initial state."""


class TaskSource:
    """What a task's class and modules define. The signatures fit those of ``core.task.FUNCTIONS``."""

    def __init__(self, definition: type[Task]) -> None:
        self.definition = definition
        self._owners: Any = definition.__mro__[: definition.__mro__.index(Task)]
        self._variant: Variant | None = None
        self.world: Any = self._struct("World")
        declared: Any = self._struct("Params")
        replaced = {"__module__": declared.cls.__module__, **definition.params}
        self.defaults: type = type("Params", (declared.cls,), replaced) if definition.params else declared.cls
        """The class whose attributes are the defaults of Params."""
        self.params: Any = self._with_functions(declared)
        self._variant = variant_of(self._owners, self.world, self.params, declared)
        self.memory: dict[str, Part] = parts_of(self.world, "World")
        self.shared_structs = self._shared_structs()
        """``Shared`` and ``Sums`` by name, or nothing."""
        self.types = self._field_types()
        """The types of World's fields and of each kind of memory, by name."""
        self.functions = {name: self._function(form) for name, form in FUNCTIONS.items()}
        """The functions of ``FUNCTIONS`` that the task defines. Others are None."""
        if self.functions["observe"] is None:
            raise ValueError("there is no observe(s, p, obs), which every task needs")
        self.terms = Terms(definition, self._term, self.functions, self.world, self.params)

    @functools.cached_property
    def written(self) -> dict[str, frozenset[str]]:
        """The fields and the parts of memory that each function writes."""
        return {name: written_fields(function) for name, function in self.functions.items() if function is not None}

    @property
    def curriculum(self) -> tuple[str, ...]:
        """Names of the lasting memory that functions other than ``startup`` write."""
        trained = frozenset[str]().union(*(fields for name, fields in self.written.items() if name != "startup"))
        return tuple(name for name in self._lasting() if name in trained)

    def check_bodies(self, observers: Mapping[str, wp.Function]) -> None:
        """Raise a ValueError if a function reads or writes what it must not.

        ``observers`` are the functions of the observation groups, by group name.
        """
        rights = {name: self._rights_of(form) for name, form in FUNCTIONS.items()}
        rights |= {observer_name(group): rights["observe"] for group in observers}
        functions = {name: function for name, function in self.functions.items() if function is not None}
        functions |= {observer_name(group): function for group, function in observers.items()}
        for name, function in functions.items():
            check_writes(name, function, rights)
        for name in _BEFORE_FORWARD & functions.keys():
            check_reads(name, functions[name])
        for name, term in self.terms.functions.items():
            for overload in overloads(term):
                none = {name: dict.fromkeys(overload.input_types, ())}
                check_writes(name, overload, rights | none)

    def observers(self, groups: Collection[str]) -> dict[str, wp.Function]:
        """Return the functions that write observation groups, by group name."""
        observers = {}
        for group in groups:
            form = dataclasses.replace(FUNCTIONS["observe"], name=observer_name(group))
            observer = self._function(form)
            if observer is None:
                raise ValueError(f"no function writes the group {group!r} of observations: add {form.signature}")
            observers[group] = observer
        return observers

    def group_structs(self) -> dict[str, Any]:
        """Return the structs into which functions write observation groups, by group name."""
        scopes = [scope for owner in reversed(self._owners) for scope in (owner.scope, vars(owner))]
        names = dict.fromkeys(name for scope in scopes for name in scope if name.startswith(GROUP_PREFIX))
        observers = self.observers(["policy", *(n.removeprefix(GROUP_PREFIX) for n in names if self._observes(n))])
        return {group: list(observer.input_types.values())[2] for group, observer in observers.items()}

    def _observes(self, name: str) -> bool:
        """Whether a function has the arguments of ``observe``. Others are helpers, or belong to another task."""
        function, form = self._look_up(name), FUNCTIONS["observe"]
        kinds = tuple(map(self._kind, getattr(function, "input_types", {}).values()))
        return kinds in (form.kinds, form.all_kinds)

    def _look_up(self, name: str, accepts: Callable[[Any], bool] = lambda value: value is not None) -> Any:
        """Look up a name in the class, in its module, and in the base classes and their modules."""
        for owner in self._owners:
            for scope in (vars(owner), owner.scope, vars(sys.modules[owner.__module__])):
                value = scope.get(name)
                value = value.__func__ if isinstance(value, staticmethod) else value
                if accepts(value):
                    return value if self._variant is None else self._variant.seen(value)
        return None

    def _term(self, name: str) -> wp.Function | None:
        function: wp.Function | None = self._look_up(name, lambda f: isinstance(f, wp.Function) and f.func is not None)
        return function

    # structs

    def _struct(self, name: str) -> Any:
        struct = self._declared(name, self.definition)
        if isinstance(struct, type):
            raise ValueError(f"{name} must be a Warp struct: decorate it with @wp.struct")
        if not is_struct(struct):
            raise ValueError(f"there is no {name}: add a @wp.struct of this name to the task's module")
        return struct

    def _declared(self, name: str, owner: type[Task]) -> Any:
        """Return the struct that a class declares, merged with those of the parents if it extends one of them."""
        scopes = (vars(owner), owner.scope, vars(sys.modules[owner.__module__]))
        struct = next((scope[name] for scope in scopes if name in scope), None)
        parents = [self._declared(name, base) for base in owner.__bases__ if base in self._owners]
        structs = list(filter(is_struct, parents))
        if struct is None:
            return merged(structs) if structs else None
        extends = is_struct(struct) and any(issubclass(struct.cls, parent.cls) for parent in structs)
        return merged([struct, *structs]) if extends else struct

    def _with_functions(self, declared: Any) -> Any:
        """Return the parameter struct that functions take.

        A task that changes only defaults uses the struct of its base task, to share functions and kernels with it.
        """
        fields = {name: wp.types.type_repr(field.type) for name, field in declared.vars.items()}
        for owner in reversed(self._owners):
            struct = vars(owner).get("Params", owner.scope.get("Params"))
            known = struct.vars.items() if is_struct(struct) and issubclass(declared.cls, struct.cls) else ()
            if {name: wp.types.type_repr(field.type) for name, field in known} == fields:
                return struct
        return declared

    def _shared_structs(self) -> dict[str, Any]:
        field, tally, share = self.world.vars.get("shared"), self._look_up("tally"), self._look_up("share")
        if field is None and tally is None and share is None:
            return {}
        structs = [list(function.input_types.values())[i] for function, i in ((tally, 5), (share, 1))
                   if isinstance(function, wp.Function) and len(function.input_types) > i]  # fmt: skip
        if field is None or not is_struct(field.type) or len(structs) < 2 or structs[0] is not structs[1]:
            raise ValueError(
                "a part of shared memory is missing: it needs the structs Shared and Sums, a field World.shared of the "
                f"type Shared, and the functions {FUNCTIONS['tally'].signature} and {FUNCTIONS['share'].signature}"
            )
        return {"Shared": field.type, "Sums": structs[0]}

    def _field_types(self) -> dict[str, Any]:
        for name, part in self.memory.items():
            if part.kind not in MEMORIES:
                raise ValueError(f"World.{name} is declared by lw.part: use lw.memory(...)")
            if is_data_field(name) or is_model_field(name) or name in OWN_PARTS:
                raise ValueError(
                    f"the memory World.{name} has the name of an existing field or part of the state: rename it"
                )
        known = (*self.memory, "shared") if self.shared_structs else self.memory
        types = {name: v.type for name, v in self.world.vars.items() if name not in known}
        kinds = {part.kind for part in self.memory.values()}
        return types | {name: Row[float] for name in MEMORIES if name in kinds}

    # functions

    def _rights_of(self, form: TaskFunction) -> Rights:
        """Return which fields of each argument a function may write."""
        model = [name for name in self.types if is_model_field(name)]
        groups = {
            "inputs": INPUTS,
            "memory": tuple(self.memory),
            "lasting": (*self._lasting(), *model),
            "start": (*INITIAL, *self.memory, *model),
        }
        return {
            name: None if name in RESULTS else groups.get(form.writes.get(name, ""), ()) for name in form.argument_names
        }

    def _lasting(self) -> list[str]:
        return [name for name, part in self.memory.items() if part.kind == "lasting_memory"]

    def _function(self, form: TaskFunction) -> wp.Function | None:
        """Look up a function and check it, or return None if the task does not define it."""
        function, name = self._look_up(form.name), form.name
        if function is None:
            return None
        if not isinstance(function, wp.Function):
            raise ValueError(f"{name} must be a @wp.func, not {function!r}")
        types = list(function.input_types.values())
        structs = [kind for kind in types if is_struct(kind)]
        foreign = structs and self.world not in structs and self.params not in structs
        if foreign and function.func.__module__ in {owner.__module__ for owner in self._owners}:
            return None  # the function belongs to another task in the module
        returns = any(isinstance(node, ast.Return) for node in ast.walk(source_of(function).tree))
        if form.result is not None and not returns:
            raise ValueError(f"{name} has no return: write it as {form.signature}")
        check_structs(function, {self.world: self.world.cls, self.params: self.defaults})
        kinds = tuple(map(self._kind, types))
        returned = function.adj.arg_types.get("return")
        if kinds not in (form.kinds, form.all_kinds) or returned not in (None, form.result):
            more = f", with or without a last argument {form.optional}" if form.optional else ""
            if form.name.startswith("observe") and len(structs) == 3:
                more = f"{more}; to write the struct {structs[2].key}, remove obs from the class"
            raise ValueError(f"{name} must be written as {form.signature}{more}")
        return function

    def _kind(self, argument: Any) -> str:
        """Return an argument's type as ``FUNCTIONS`` writes it, such as "World" or "Row[float]"."""
        structs = {"World": self.world, "Params": self.params, **self.shared_structs}
        if names := [name for name, struct in structs.items() if argument is struct]:
            return names[0]
        if is_struct(argument) and not hasattr(self.definition, "obs"):
            return "Row[float]"
        element: Any = getattr(argument, "dtype", None) if getattr(argument, "ndim", 0) == 1 else None
        kinds = {wp.float32: "Row[float]", wp.uint32: "Row[wp.uint32]"}
        return "bool" if argument in (bool, wp.bool) else kinds.get(element, "?")


def draws_noise(observer: wp.Function) -> bool:
    """Whether the function of an observation group takes a random stream."""
    return len(observer.input_types) > len(FUNCTIONS["observe"].kinds)
