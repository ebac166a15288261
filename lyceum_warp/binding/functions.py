"""Read a task's class and modules: its structs, functions, terms and memory."""

import ast
import dataclasses
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import warp as wp

from lyceum_warp.binding.parts import parts_of
from lyceum_warp.binding.sources import is_struct, name_of, overloads, source_of
from lyceum_warp.binding.task_terms import Terms
from lyceum_warp.binding.variants import Variant, merged, variant_of
from lyceum_warp.binding.writes import Rights, check_reads, check_writes, trace, written_fields
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
        for function in self._variant.replacements if self._variant else ():
            self._check_structs(function)
        self.memory: dict[str, Part] = parts_of(self.world, "World")
        self.shared_structs = self._shared_structs()
        """``Shared`` and ``Sums`` by name, or nothing."""
        self.types = self._field_types()
        """The types of World's fields and of each kind of memory, by name."""
        self.functions = {name: self._function(form) for name, form in FUNCTIONS.items()}
        """The functions of ``FUNCTIONS`` that the task defines. Others are None."""
        if self.functions["observe"] is None:
            raise ValueError("there is no observe(s, p, obs), which every task needs")
        self.observers = self._observers()
        """The functions that write observation groups, by group name. Not every group is in ``obs``."""
        rights = self._rights()
        self.terms = Terms(definition, self._term, self.functions, self.world, self.params)
        functions = self.functions | {observer_name(group): function for group, function in self.observers.items()}
        bodies = [(name, function, rights) for name, function in functions.items() if function is not None]
        for name, term in self.terms.functions.items():
            for overload in overloads(term):
                bodies.append((name, overload, rights | {name: dict.fromkeys(overload.input_types, ())}))
        for body in bodies:
            check_writes(*body)
        for name in _BEFORE_FORWARD:
            if (function := functions[name]) is not None:
                check_reads(name, function)

    @functools.cached_property
    def writes(self) -> dict[str, frozenset[str]]:
        """The fields of World and the kinds of memory that each function writes."""
        kinds = {name: part.kind for name, part in self.memory.items()}
        return {name: frozenset(kinds.get(field, field) for field in fields) for name, fields in self.written.items()}

    @functools.cached_property
    def written(self) -> dict[str, frozenset[str]]:
        """The fields and the parts of memory that each function writes."""
        return {name: written_fields(f) if f is not None else frozenset() for name, f in self.functions.items()}

    @functools.cached_property
    def read_in_substeps(self) -> frozenset[str]:
        """The fields of World that ``substep`` reads or may read."""
        function = self.functions["substep"]
        return frozenset() if function is None else written_fields(function) | trace(function).reads.keys()

    @property
    def drawn_between_steps(self) -> frozenset[str]:
        """The fields of World and the kinds of memory that resets and events write."""
        return self.writes["initialize"] | self.writes["randomize"] | self.writes["event"]

    @property
    def curriculum(self) -> tuple[str, ...]:
        """Names of the lasting memory that functions other than ``startup`` write."""
        trained = frozenset[str]().union(*(fields for name, fields in self.written.items() if name != "startup"))
        return tuple(name for name in self._lasting() if name in trained)

    def _observers(self) -> dict[str, wp.Function]:
        scopes = [scope for owner in reversed(self._owners) for scope in (owner.scope, vars(owner))]
        if hasattr(self.definition, "obs"):  # without obs, functions of later tasks in the module would add groups
            scopes += [vars(sys.modules[owner.__module__]) for owner in self._owners]
        names = dict.fromkeys(name for scope in scopes for name in scope if name.startswith(GROUP_PREFIX))
        groups = [name.removeprefix(GROUP_PREFIX) for name in names if self._observes(name)]
        forms = {g: dataclasses.replace(FUNCTIONS["observe"], name=observer_name(g)) for g in ("policy", *groups)}
        functions = {group: self._function(form) for group, form in forms.items()}
        return {group: function for group, function in functions.items() if function is not None}

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
        if not is_struct(struct):
            raise ValueError(f"{name} must be a @wp.struct in the task's module, not {struct!r}")
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
            base_fields = struct.vars.items() if is_struct(struct) and issubclass(declared.cls, struct.cls) else ()
            if {name: wp.types.type_repr(field.type) for name, field in base_fields} == fields:
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
        memory_names = (*self.memory, "shared") if self.shared_structs else self.memory
        types = {name: v.type for name, v in self.world.vars.items() if name not in memory_names}
        kinds = {part.kind for part in self.memory.values()}
        return types | {name: Row[float] for name in MEMORIES if name in kinds}

    # functions

    def _rights(self) -> dict[str, Rights]:
        """Return which fields of each argument each function may write."""
        model = [name for name in self.types if is_model_field(name)]
        fields = {
            "inputs": INPUTS,
            "memory": tuple(self.memory),
            "lasting": (*self._lasting(), *model),
            "start": (*INITIAL, *self.memory, *model),
        }
        rights: dict[str, Rights] = {
            name: {a: None if a in RESULTS else fields.get(form.writes.get(a, ""), ()) for a in form.argument_names}
            for name, form in FUNCTIONS.items()
        }
        return rights | {observer_name(group): rights["observe"] for group in self.observers}

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
        self._check_structs(function)
        kinds = tuple(map(self._kind, types))
        returned = function.adj.arg_types.get("return")
        if kinds not in (form.kinds, form.all_kinds) or returned not in (None, form.result):
            more = f", with or without a last argument {form.optional}" if form.optional else ""
            if form.name.startswith("observe") and len(structs) == 3:
                more = f"{more}; to write the struct {structs[2].key}, remove obs from the class"
            raise ValueError(f"{name} must be written as {form.signature}{more}")
        return function

    def _check_structs(self, function: wp.Function) -> None:
        """Raise a ValueError if a function takes another World or Params than the task uses."""
        declared = {"World": self.world.cls, "Params": self.defaults}
        for kind in filter(is_struct, function.input_types.values()):
            name = kind.key.rpartition(".")[2]
            if kind not in (self.world, self.params) and (cls := declared.get(name)) is not None:
                bases = [base for base in cls.__bases__ if base is not object and not issubclass(kind.cls, base)]
                named = ", ".join(f"{Path(_file(base)).stem}.{base.__name__}" for base in (*bases, kind.cls))
                raise ValueError(
                    f"{name_of(function)} takes {name} from {_file(kind.cls)}, but the task uses {name} from "
                    f"{_file(cls)}: import World and Params from the same file, write the task's struct as class "
                    f"{name}({named}), or rewrite {name_of(function)}"
                )

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


def _file(cls: type) -> str:
    return str(getattr(sys.modules.get(cls.__module__), "__file__", None) or cls.__module__)
