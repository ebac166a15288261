"""A task bound to its parameters and its model, and how its functions become kernels."""

import difflib
import linecache
import re
import sys
from collections.abc import Mapping
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from lyceum_warp import models
from lyceum_warp.fields import elements
from lyceum_warp.kernels import steps
from lyceum_warp.registry import task_name
from lyceum_warp.task import Element, Task
from lyceum_warp.validate import whole_number

FUNCTIONS = (
    "observe",
    "control",
    "reward",
    "evaluate",
    "terminated",
    "success",
    "initialize",
    "randomize",
    "advance",
)


_MISSING = {"obs": 'the parts of its observation, as obs = {"position": 5}', "model": 'a model, as model = "robot.xml"'}


class BoundTask:
    """A task with its parameters, its compiled model and its kernels.

    Args:
        task: The task's class.
        nworld: Number of worlds, for parameters that differ between them.
        model: Another model than the task's own.
        frame_skip: Another number of substeps.
        cone: Another friction cone.
        params: Values for the fields of ``Params``; for a scalar also one value a world.

    Raises:
        ValueError: Something in the task or in the parameters does not fit together.
    """

    def __init__(
        self,
        task: type[Task],
        nworld: int = 1,
        *,
        model: models.ModelSource | None = None,
        frame_skip: int | None = None,
        cone: str | None = None,
        **params: Any,
    ) -> None:
        self.task = task
        self.name = task_name(task)
        self.module: ModuleType = sys.modules[task.__module__]
        self.world_struct = self._struct("World")
        self.params_struct = self._struct("Params")
        self.functions = {name: self._function(name) for name in FUNCTIONS}
        if self.functions["observe"] is None:
            raise ValueError(f"the task {self.name!r} has no observe(s, p, obs), the one function it needs")
        self.fields = {name: variable.type for name, variable in self.world_struct.vars.items()}
        if ("memory" in self.fields) != (task.memory > 0):
            raise ValueError(f"the task {self.name!r} needs both, memory = ... in the class and memory in World")
        for name in task.lagged:
            if name not in self.fields:
                raise ValueError(f"the task {self.name!r} wants {name!r} lagged but does not list it in World")

        for name in ("obs", "model"):
            if not hasattr(task, name) and (name == "obs" or model is None):
                raise ValueError(f"the task {self.name!r} has no {name}: add {_MISSING[name]} to its class")
        source = model if model is not None else task.model() if callable(task.model) else task.model
        engine_fields = [name for name in self.fields if name != "memory"]
        self.model = models.compile_model(models.load_spec(source, task), engine_fields, cone=cone)
        self.frame_skip = whole_number("frame_skip", task.frame_skip if frame_skip is None else frame_skip, low=1)
        self.timestep = self.model.opt.timestep * self.frame_skip
        self.nworld = nworld
        self.params = self._default_params()
        self.params.update(self._checked_params(params))
        self.obs_layout = self.layout()
        self.kernels = kernels_of(self)

    def layout(self) -> dict[str, int]:
        """The observation's parts and their sizes, for the parameters as they are."""
        params = SimpleNamespace(**self.params)
        layout = self.task.obs(params) if callable(self.task.obs) else self.task.obs
        return {name: int(size) for name, size in layout.items() if size}

    def _struct(self, name: str) -> Any:
        struct = getattr(self.task, name, None) or getattr(self.module, name, None)
        if not hasattr(struct, "vars"):
            raise ValueError(f"the task {self.name!r} needs a @wp.struct named {name} in its module")
        return struct

    def _function(self, name: str) -> wp.Function | None:
        function = vars(self.task).get(name, getattr(self.module, name, None))
        if isinstance(function, staticmethod):
            function = function.__func__
        if function is None:
            return None
        if not isinstance(function, wp.Function):
            raise ValueError(f"{name} of the task {self.name!r} has to be a @wp.func, not {function!r}")
        return function

    # parameters

    def _default_params(self) -> dict[str, Any]:
        # Warp's structs ignore defaults: they are read from the class behind the struct
        values: dict[str, Any] = {}
        for name in self.params_struct.vars:
            if name == "dt":
                values["dt"] = self.timestep
            elif hasattr(self.params_struct.cls, name):
                values[name] = getattr(self.params_struct.cls, name)
        return values

    def _checked_params(self, given: Mapping[str, Any]) -> dict[str, Any]:
        known = self.params_struct.vars
        for name in given:
            if name not in known or name == "dt":
                names = sorted(set(known) - {"dt"})
                close = difflib.get_close_matches(name, names, 3)
                hint = f"did you mean {' or '.join(close)}?" if close else f"it has {', '.join(names) or 'none'}"
                raise ValueError(f"the task {self.name!r} has no parameter {name!r}: {hint}")
        missing = [name for name in known if name not in self.params and name not in given]
        if missing:
            raise ValueError(f"the task {self.name!r} needs values for {', '.join(missing)}")
        values = {name: self._converted(name, value) for name, value in given.items()}
        return {name: self._converted(name, value) for name, value in self.params.items()} | values

    def _converted(self, name: str, value: Any) -> Any:
        """A parameter as what its field holds: a scalar or vector, or an array with one a world."""
        if isinstance(value, Element):
            return elements(self.model, value.field, value.name).start
        kind = self.params_struct.vars[name].type
        width = getattr(kind, "_shape_", ())
        is_number = not width
        try:
            array = np.asarray(value, dtype=np.float64)  # Warp's own vectors, lists and tensors alike
        except (TypeError, ValueError) as error:
            raise ValueError(f"the parameter {name}={value!r} of {self.name!r} is no number: {error}") from error
        if np.isnan(array).any():
            raise ValueError(f"the parameter {name}={value!r} of {self.name!r} is not a number")
        if array.shape == tuple(width):
            if not is_number:
                return kind(*array.ravel())
            if kind in (wp.bool, wp.int32) and not (array == np.round(array)).all():
                raise ValueError(f"the parameter {name}={value!r} of {self.name!r} has to be a whole number")
            return {wp.bool: bool, wp.int32: int}.get(kind, float)(array.item())
        if array.shape == (self.nworld, *width):
            return array
        per_world = (self.nworld, *width)
        raise ValueError(
            f"the parameter {name} of {self.name!r} has shape {array.shape}; it takes {tuple(width) or 'one number'}"
            f", or one a world, {per_world}"
        )

    def _instance(self, world: int) -> Any:
        instance = self.params_struct()
        for name, value in self.params.items():
            kind = self.params_struct.vars[name].type
            if isinstance(value, np.ndarray):
                value = kind(*value[world].ravel()) if getattr(kind, "_shape_", ()) else kind(value[world])
            setattr(instance, name, value)
        return instance

    def check_field(self, name: str, array: wp.array) -> None:
        """Compare the declaration of a field in World with the array that it will be bound to, (nworld, ...).

        Raises:
            ValueError: They differ in type or in axes.
        """
        kind = self.fields[name]
        dtype, ndim = (kind.dtype, kind.ndim) if hasattr(kind, "ndim") else (kind, 0)
        if not wp.types.types_equal(dtype, array.dtype) or ndim != array.ndim - 1:
            wanted = array.dtype.__name__ if array.ndim == 1 else f"Row[{wp.types.type_repr(array.dtype)}]"
            raise ValueError(f"World.{name} of the task {self.name!r} has to be declared as {wanted}")

    def params_array(self, device: wp.Device) -> wp.array:
        """The parameters as the kernels read them: one entry, or one a world where any differs."""
        differ = any(isinstance(value, np.ndarray) for value in self.params.values())
        instances = [self._instance(w) for w in range(self.nworld if differ else 1)]
        return wp.array(instances, dtype=self.params_struct, device=device)


# The functions of a task see one world. What follows is the batch around them: a struct of the same fields
# with one more axis, and a view of world w in it. Both have to be source text, because Warp compiles source.

_VIEW = """
@wp.struct
class Batch:
{batch}


@wp.func
def view(batch: Batch, w: int) -> World:
    s = World()
{rows}
    return s


@wp.func
def no_reward(s0: World, action: wp.array[float], s1: World, p: Params) -> float:
    return 0.0


@wp.func
def no_evaluate(s: World, p: Params) -> float:
    return 0.0


@wp.func
def no_flag(s: World, p: Params) -> bool:
    return False


@wp.func
def no_initialize(s: World, p: Params):
    pass


@wp.func
def no_randomize(s: World, p: Params, rng: wp.array[wp.uint32]):
    pass


@wp.func
def no_advance(s0: World, action: wp.array[float], s1: World, p: Params, rng: wp.array[wp.uint32]):
    pass


@wp.func
def no_control(s: World, action: wp.array[float], p: Params, ctrl: wp.array[float]):
    pass
"""

_DEFAULTS = {
    "reward": "no_reward",
    "evaluate": "no_evaluate",
    "terminated": "no_flag",
    "success": "no_flag",
    "initialize": "no_initialize",
    "randomize": "no_randomize",
    "advance": "no_advance",
    "control": "no_control",
}

_cache: dict[Any, Any] = {}
_modules: list[str] = []


def kernels_of(bound: BoundTask) -> Any:
    """The kernels of a task, made once for the same functions and structs."""
    functions = tuple(bound.functions[name] for name in FUNCTIONS)
    key = (bound.world_struct, bound.params_struct, functions)
    if key not in _cache:
        scope = _batched(bound)
        filled = {name: bound.functions[name] or scope[_DEFAULTS[name]] for name in FUNCTIONS if name in _DEFAULTS}
        _cache[key] = steps.make_kernels(
            scope["Batch"],
            scope["view"],
            bound.params_struct,
            module=_module_name(bound.task),
            observe=bound.functions["observe"],
            has_control=bound.functions["control"] is not None,
            has_evaluate=bound.functions["evaluate"] is not None,
            has_advance=bound.functions["advance"] is not None,
            **filled,
        )
    return _cache[key]


def _module_name(task: type[Task]) -> str:
    """The same name in every process, so that Warp finds the module in its cache; once more if it is taken."""
    name = f"lyceum_warp.generated.{task.__module__}.{task.__qualname__}"
    taken = sum(module == name or module.startswith(f"{name}#") for module in _modules)
    _modules.append(f"{name}#{taken}" if taken else name)
    return re.sub(r"[^\w.]", "_", _modules[-1])


def _batched(bound: BoundTask) -> dict[str, Any]:
    """Run the generated source: the batched struct, the view of one world, and defaults for its functions."""
    scope: dict[str, Any] = {"wp": wp, "World": bound.world_struct, "Params": bound.params_struct}
    batch, rows = [], []
    for name, kind in bound.fields.items():
        if hasattr(kind, "ndim"):
            scope[f"type_{name}"] = wp.array(dtype=kind.dtype, ndim=kind.ndim + 1)
        else:
            scope[f"type_{name}"] = wp.array(dtype=kind, ndim=1)
        batch.append(f"    {name}: type_{name}")
        rows.append(f"    s.{name} = batch.{name}[w]")
    source = _VIEW.format(batch="\n".join(batch), rows="\n".join(rows))
    file = f"<lyceum_warp {bound.task.__module__}.{bound.task.__qualname__}>"
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    scope["__name__"] = f"lyceum_warp.generated.{bound.name}"
    exec(compile(source, file, "exec"), scope)
    return scope
