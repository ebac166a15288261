"""Copy the functions of a family of tasks, so that each task can run them with structs and functions of its own.

Warp compiles a function for the structs in its annotations. If a task extends its parent's World, the parent's
functions are therefore copied, and the copies take the task's World. If the task replaces one of the parent's
functions, the copies call the replacement. If a task has several parents, their structs are merged, and their functions
call each other as methods do with ``super()``.
"""

import functools
import itertools
import sys
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import warp as wp

from lyceum_warp.binding.sources import has_source, is_struct, overloads
from lyceum_warp.core.task import FUNCTIONS, GROUP_PREFIX, Task


class Variant:
    """Copies of the functions of a task and its parents.

    In the copies, the task's structs and functions replace those of the parents.

    Args:
        modules: The modules of the task and its parents. The task's module comes first.
        functions: The functions with Python source in these modules.
        structs: The replacements of structs.
        replacements: The replacements of functions.
    """

    def __init__(
        self,
        modules: Sequence[types.ModuleType],
        functions: Sequence[wp.Function],
        structs: Mapping[Any, Any],
        replacements: Mapping[wp.Function, wp.Function],
    ) -> None:
        self._modules = {module.__name__: module for module in modules}
        self._structs, self._replacements = structs, replacements
        self._copies: dict[wp.Function, wp.Function] = {}
        # Warp evaluates wp.static(...) when it defines a function, so the structs must be in the scope
        scopes = {module.__name__: self._with_structs(vars(module)) for module in modules}
        homes = {name: wp.Module(name, None) for name in scopes}
        for function in functions:
            home = _home(function)
            self._copies[function] = self._copy(function, scopes[home], homes[home])
        for name, scope in scopes.items():
            scope |= {key: self.seen(value, name) for key, value in scope.items()}
        self.replacements = [self.seen(function, _home(function)) for function in replacements.values()]
        """The copies of the functions that replace others."""

    def seen(self, value: Any, viewer: str = "") -> Any:
        """Return the replacement of a function, a struct or a module of the family.

        ``viewer`` is the name of the module whose code refers to ``value``. The module that defines a replacement still
        gets the original, so that the replacement can call it.
        """
        if isinstance(value, wp.Function):
            while (replacement := self._replacements.get(value)) is not None and _home(replacement) != viewer:
                value = replacement
            return self._copies.get(value, value)
        if is_struct(value):
            return self._structs.get(value, value)
        if isinstance(value, types.ModuleType) and viewer and self._modules.get(value.__name__) is value:
            proxy = types.ModuleType(value.__name__)
            for name, attribute in vars(value).items():
                if not isinstance(attribute, types.ModuleType):
                    setattr(proxy, name, self.seen(attribute, viewer))
            return proxy
        return value

    def _with_structs(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: self._structs.get(value, value) if is_struct(value) else value for name, value in values.items()}

    def _copy(self, function: wp.Function, scope: dict[str, Any], home: wp.Module) -> wp.Function:
        copies: list[Any] = []
        for overload in overloads(function):
            body: Any = overload.func
            copy = types.FunctionType(body.__code__, scope, body.__name__, body.__defaults__, body.__closure__)
            copy.__annotations__ = self._with_structs(body.__annotations__)
            copy.__module__, copy.__qualname__, copy.__doc__ = body.__module__, body.__qualname__, body.__doc__
            copies.append(wp.func(module=home)(copy))
        first, *others = copies
        for other in others:
            first.add_overload(other)
        return first


_variants: dict[Any, Variant] = {}


def variant_of(owners: Sequence[type[Task]], world: Any, params: Any, declared: Any) -> Variant | None:
    """Copy a family's functions for a task, or return None if the task has no structs or functions of its own.

    Tasks with the same structs and replacements share a variant and its compiled kernels. ``declared`` is the Params
    struct that the task declares, and ``params`` is the Params struct that its functions take. If the task changes only
    defaults, ``params`` is the struct of the base task. Otherwise, the two are identical.
    """
    modules = list(dict.fromkeys(sys.modules[owner.__module__] for owner in owners))
    values = [value for module in modules for value in _values(module, owners)]
    structs = _new_structs(filter(is_struct, values), {declared: params, world: world, params: params})
    declaring = [value for value in values if isinstance(value, wp.Function) and hasattr(value, "replaces")]
    replacements = _next_functions(owners) | {function.replaces: function for function in reversed(declaring)}
    modules = _with_helpers(modules, owners, {*structs, *structs.values(), world, params})
    functions = _functions(modules, owners)
    arguments = {kind for function in functions for overload in overloads(function)
                 for kind in overload.input_types.values() if is_struct(kind)}  # fmt: skip
    structs = {struct: new for struct, new in structs.items() if struct in arguments}
    if not structs and not replacements:  # the task needs no copies, for example because it changes only defaults
        return None
    key = (tuple(modules), tuple(functions), tuple(structs.items()), tuple(replacements.items()))
    if key not in _variants:
        _variants[key] = Variant(modules, functions, structs, replacements)
    return _variants[key]


def _functions(modules: Sequence[types.ModuleType], owners: Sequence[type[Task]]) -> list[wp.Function]:
    """List the functions with Python source that modules define."""
    values = dict.fromkeys(v for module in modules for v in _values(module, owners) if isinstance(v, wp.Function))
    return [function for function in values if has_source(function) and sys.modules.get(_home(function)) in modules]


def merged(structs: Iterable[Any]) -> Any:
    """Return the struct that extends all others. If none does, make one."""
    unique = dict.fromkeys(structs)
    last = [s for s in unique if not any(s is not other and issubclass(other.cls, s.cls) for other in unique)]
    return last[0] if len(last) == 1 else _merge(*last)


@functools.cache
def _merge(*structs: Any) -> Any:
    names = {"__module__": structs[0].cls.__module__}
    return wp.struct(types.new_class(structs[0].cls.__name__, structs, exec_body=lambda body: body.update(names)))


def _new_structs(family: Iterable[Any], main: Mapping[Any, Any]) -> dict[Any, Any]:
    """Map each struct of a family to the struct that the task's functions take.

    ``main`` maps the task's World and Params. A struct that one of these extends maps to this one. Any other struct,
    such as an observation's, maps to the struct of the same name that extends it.
    """
    structs, family = dict(main), list(family)
    for parent in family:
        if parent not in structs:
            children = [struct for struct in main.values() if issubclass(struct.cls, parent.cls)]
            namesakes = [struct for struct in family if struct.key == parent.key and issubclass(struct.cls, parent.cls)]
            structs |= {parent: children[0]} if children else dict.fromkeys(namesakes, merged(namesakes))
    return {struct: new for struct, new in structs.items() if struct is not new}


def _next_functions(owners: Sequence[type[Task]]) -> dict[wp.Function, wp.Function]:
    """Find the calls of a common parent's function that must go to another parent's, as with Python's ``super()``.

    If two parents of a task extend ``advance`` of a common parent, the first one's call of the common ``advance`` goes
    to the second one's. The result then maps the common function to the second one's.
    """
    scopes = {owner: {**vars(sys.modules[owner.__module__]), **owner.scope, **vars(owner)} for owner in owners}
    names = dict.fromkeys(name for scope in scopes.values() for name in scope)
    replacements: dict[wp.Function, wp.Function] = {}
    for name in (name for name in names if name in FUNCTIONS or name.startswith(GROUP_PREFIX)):
        functions: dict[wp.Function, type[Task]] = {}
        for owner, scope in scopes.items():
            value = scope.get(name)
            value = value.__func__ if isinstance(value, staticmethod) else value
            if isinstance(value, wp.Function) and _home(value) == owner.__module__:
                functions[value] = owner  # the last owner, because the classes of a module share its functions
        if len(functions) < 3:
            continue
        first, *others = functions
        common = next((f for f in others if issubclass(functions[first], functions[f])), None)
        if common is not None:
            head, base = functions[first], functions[common]
            siblings = [f for f, owner in functions.items() if issubclass(owner, base) and not issubclass(head, owner)]
            replacements |= itertools.pairwise([common, *reversed(siblings)])
    return replacements


def _with_helpers(
    modules: Sequence[types.ModuleType], owners: Sequence[type[Task]], structs: set[Any]
) -> list[types.ModuleType]:
    """Add the modules from which the family imports functions that take one of the given structs."""
    family, pending = list(modules), list(modules)
    while pending:
        for value in _values(pending.pop(0), owners):
            home = sys.modules.get(_home(value)) if isinstance(value, wp.Function) else value
            if isinstance(home, types.ModuleType) and home not in family and _names(home, structs):
                family.append(home)
                pending.append(home)
    return family


def _home(function: wp.Function) -> str:
    return str(function.func.__module__) if function.func is not None else ""


def _values(module: types.ModuleType, owners: Sequence[type[Task]]) -> Iterator[Any]:
    """Yield the attributes of a module's tasks, and the module's globals.

    Globals include those that existed when a task was defined.
    """
    for owner in owners:
        if owner.__module__ == module.__name__:
            for value in vars(owner).values():
                yield value.__func__ if isinstance(value, staticmethod) else value
            yield from owner.scope.values()
    yield from list(vars(module).values())


def _names(module: types.ModuleType, structs: set[Any]) -> bool:
    return any(
        isinstance(value, wp.Function) and _home(value) == module.__name__
        and any(is_struct(kind) and kind in structs for f in overloads(value) for kind in f.input_types.values())
        for value in vars(module).values()
    )  # fmt: skip
