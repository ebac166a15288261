"""A task bound to its parameters and its model, and how its functions become kernels."""

import ast
import difflib
import inspect
import linecache
import math
import re
import sys
import textwrap
from collections.abc import Collection, Mapping
from types import ModuleType, SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.binding import models
from lyceum_warp.binding.registry import task_name
from lyceum_warp.fields import elements, vec10
from lyceum_warp.kernels import steps
from lyceum_warp.task import FUNCTIONS, Element, Task
from lyceum_warp.validate import whole_number

_SIGNATURES = {
    "observe": ("observe(s: World, p: Params, obs: Row[float])", "WPr", None),
    "control": ("control(s: World, action: Row[float], p: Params, ctrl: Row[float])", "WrPr", None),
    "reward": ("reward(s0: World, action: Row[float], s1: World, p: Params) -> float", "WrWP", float),
    "evaluate": ("evaluate(s: World, p: Params) -> float", "WP", float),
    "terminated": ("terminated(s: World, p: Params) -> bool", "WP", bool),
    "success": ("success(s: World, p: Params) -> bool", "WP", bool),
    "initialize": ("initialize(s: World, p: Params)", "WP", None),
    "randomize": ("randomize(s: World, p: Params, rng: Row[wp.uint32])", "WPu", None),
    "advance": ("advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32])", "WrWPu", None),
}
"""How each function is written, the kinds of its arguments, and its result."""

_OPTIONS = (
    "nworld", "device", "engine", "seed", "autoreset", "horizon", "record", "model", "frame_skip", "cone", "integrator",
    "solver", "deterministic", "unroll", "fields", "nvtx",
)  # fmt: skip
_OTHER_WORDS = {
    "num_envs": ["nworld"], "n_envs": ["nworld"], "xml_file": ["model"], "max_episode_steps": ["horizon"],
    "iterations": ["solver={'iterations': ...}"], "ls_iterations": ["solver={'ls_iterations': ...}"],
    "noslip_iterations": ["solver={'noslip_iterations': ...}"],
}  # fmt: skip

_SPELLED = {
    "float32": "float", "int32": "int", "vec3f": "wp.vec3", "quatf": "wp.quat", "mat33f": "wp.mat33",
    "spatial_vectorf": "wp.spatial_vector",
}  # fmt: skip

_UNWRITTEN = 7.25e33
"""A number that no observation is likely to be."""

_MISSING = {"obs": 'the parts of its observation, as obs = {"position": 5}', "model": 'a model, as model = "robot.xml"'}


def _returns(function: wp.Function) -> bool:
    """Whether a function returns something anywhere; true, too, where its source is not known."""
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function.func)))  # type: ignore[arg-type]
    except (OSError, SyntaxError, TypeError):
        return True
    return any(isinstance(node, ast.Return) and node.value is not None for node in ast.walk(tree))


def task_spec(task: type[Task], model: models.ModelSource | None = None) -> mujoco.MjSpec:
    """A task's model, or another one that is given for it, editable; see ``models.load_spec``."""
    if model is not None:
        return models.load_spec(model)
    return models.load_spec(task.model() if callable(task.model) else task.model, task)


def _written(task: type[Task], name: str) -> Any:
    """What the user calls by a name: in the class, in its module, or in those of the classes it extends."""
    owners: Any = task.__mro__[: task.__mro__.index(Task)]
    for owner in owners:
        found = vars(owner).get(name, owner.scope.get(name, vars(sys.modules[owner.__module__]).get(name)))
        if found is not None:
            return found.__func__ if isinstance(found, staticmethod) else found
    return None


def _struct(task: type[Task], name: str) -> Any:
    struct = _written(task, name)
    if not hasattr(struct, "vars"):
        raise ValueError(f"the task {task_name(task)!r} needs a @wp.struct named {name} in its module")
    return struct


def parameter_names(task: type[Task]) -> tuple[str, ...]:
    """Names of a task's parameters: the fields of its ``Params`` without ``dt``.

    Raises:
        ValueError: The task has no ``Params``.
    """
    return tuple(name for name in _struct(task, "Params").vars if name != "dt")


class BoundTask:
    """A task with its parameters, its compiled model and its kernels.

    Args:
        task: The task's class.
        nworld: Number of worlds, for parameters that differ between them.
        model: Another model than the task's own.
        frame_skip: Another number of substeps.
        fields: Further fields that the engine has to keep.
        cone, integrator, solver: Other physics options than the model's, see ``models.compile_model``.
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
        integrator: str | None = None,
        solver: Mapping[str, int] | None = None,
        fields: Collection[str] = (),
        **params: Any,
    ) -> None:
        self.task = task
        self.name = task_name(task)
        self.module: ModuleType = sys.modules[task.__module__]
        self.world_struct = _struct(task, "World")
        self.params_struct = _struct(task, "Params")
        self.functions = {name: self._function(name) for name in FUNCTIONS}
        if self.functions["observe"] is None:
            raise ValueError(f"the task {self.name!r} has no observe(s, p, obs), the one function it needs")
        self._check_names()
        self.fields = {name: variable.type for name, variable in self.world_struct.vars.items()}
        if ("memory" in self.fields) != (task.memory > 0):
            raise ValueError(f"the task {self.name!r} needs both, memory = ... in the class and memory in World")
        for name in task.lagged:
            if name not in self.fields:
                raise ValueError(f"the task {self.name!r} wants {name!r} lagged but does not list it in World")

        for name in ("obs", "model"):
            if not hasattr(task, name) and (name == "obs" or model is None):
                raise ValueError(f"the task {self.name!r} has no {name}: add {_MISSING[name]} to its class")
        names = isinstance(fields, Collection) and not isinstance(fields, str)
        if not names or not all(isinstance(name, str) for name in fields):
            raise ValueError(f"fields has to be names of fields, as in fields=['sensordata'], not {fields!r}")
        self.further = tuple(fields)
        """Fields that are kept for others than the task."""
        engine_fields = [*(name for name in self.fields if name != "memory"), *self.further]
        spec = task_spec(task, model)
        self.model = models.compile_model(spec, engine_fields, cone=cone, integrator=integrator, solver=solver)
        if self.model.nu == 0:
            raise ValueError(f"the model of the task {self.name!r} has no actuators, so there is nothing to act on")
        whole_number(f"horizon of the task {self.name!r}", task.horizon, low=0)
        self.frame_skip = whole_number("frame_skip", task.frame_skip if frame_skip is None else frame_skip, low=1)
        self.timestep = self.model.opt.timestep * self.frame_skip
        self.nworld = nworld
        self._sizes: dict[str, int] = {}
        self.params = self._default_params()
        self.params.update(self.checked_params(params))
        self.obs_layout = self.layout()
        self.kernels = kernels_of(self)

    def layout(self) -> dict[str, int]:
        """The observation's parts and their sizes, for the parameters as they are."""
        params = SimpleNamespace(**self.params)
        layout = self.task.obs(params) if callable(self.task.obs) else self.task.obs
        if not isinstance(layout, Mapping):
            raise ValueError(f"obs of the task {self.name!r} is {layout!r}: add {_MISSING['obs']}")
        if per_world := [name for name, size in layout.items() if np.ndim(size)]:
            raise ValueError(f"obs of the task {self.name!r} differs between worlds in {per_world}: give one value")
        return {name: int(size) for name, size in layout.items() if size}

    def _function(self, name: str) -> wp.Function | None:
        function = _written(self.task, name)
        if function is None:
            return None
        signature, kinds, result = _SIGNATURES[name]
        if not isinstance(function, wp.Function):
            raise ValueError(f"{name} of the task {self.name!r} has to be a @wp.func, not {function!r}")
        types = list(function.input_types.values())
        structs = [kind for kind in types if hasattr(kind, "vars")]
        if structs and self.world_struct not in structs and self.params_struct not in structs:
            return None  # another task's, left over in a notebook
        found = "".join(map(self._kind, types))
        annotations = function.func.__annotations__
        if any(isinstance(annotation, str) for annotation in annotations.values()):
            raise ValueError(
                f"{name} of the task {self.name!r} has annotations that are text, not types: leave out "
                "'from __future__ import annotations', and quotes around types"
            )
        returned = annotations.get("return")
        if result is not None and not _returns(function):
            raise ValueError(f"{name} of the task {self.name!r} has no return: it is written as {signature}")
        if found != kinds or (returned is not None and returned is not result):
            raise ValueError(f"{name} of the task {self.name!r} has to be written as {signature}")
        return function

    def _kind(self, argument: Any) -> str:
        if argument is self.world_struct:
            return "W"
        if argument is self.params_struct:
            return "P"
        element: Any = getattr(argument, "dtype", None) if getattr(argument, "ndim", 0) == 1 else None
        return {wp.float32: "r", wp.uint32: "u"}.get(element, "?")

    def _check_names(self) -> None:
        """Refuse what looks like a slip of the pen: nobody would ever call it."""
        attributes = [name for name in vars(Task) if not name.startswith("_")]
        for name in vars(self.task):
            if name.startswith("_") or name in (*attributes, "World", "Params", *FUNCTIONS):
                continue
            if close := difflib.get_close_matches(name, (*attributes, *FUNCTIONS), 1, 0.75):
                raise ValueError(f"the task {self.name!r} has {name!r} in its class: did you mean {close[0]}?")
        for name, value in vars(self.module).items():
            if isinstance(value, wp.Function) and name not in FUNCTIONS:
                own = self._kind(next(iter(value.input_types.values()), None)) == "W"
                close = difflib.get_close_matches(name, [f for f in FUNCTIONS if self.functions[f] is None], 1, 0.85)
                if own and close:
                    raise ValueError(f"the task {self.name!r} has a function {name!r}: did you mean {close[0]}?")

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

    def checked_params(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """All parameters, with those that are given, as what their fields hold."""
        known = self.params_struct.vars
        for name in given:
            if name not in known or name == "dt":
                names = sorted(set(known) - {"dt"})
                close = _OTHER_WORDS.get(name) or difflib.get_close_matches(name, [*names, *_OPTIONS], 3)
                hint = f"did you mean {' or '.join(close)}?" if close else f"it has {', '.join(names) or 'none'}"
                raise ValueError(f"the task {self.name!r} has no parameter {name!r}: {hint}")
        missing = [name for name in known if name not in self.params and name not in given]
        if missing:
            raise ValueError(f"the task {self.name!r} needs values for {', '.join(missing)}")
        values = {name: self._converted(name, value) for name, value in given.items()}
        return {name: self._converted(name, value) for name, value in self.params.items()} | values

    def _converted(self, name: str, value: Any) -> Any:
        """A parameter as what its field holds: a scalar or vector, or an array with one a world."""
        kind = self.params_struct.vars[name].type
        default = getattr(self.params_struct.cls, name, None)
        if isinstance(value, Element):
            if not isinstance(default, Element) or default.field != value.field:
                raise ValueError(
                    f"the parameter {name} of {self.name!r} can't be an element of {value.field!r}: it is "
                    + (f"one of {default.field!r}" if isinstance(default, Element) else "a number")
                )
            if kind is not wp.int32:
                raise ValueError(f"the parameter {name} of {self.name!r} has to be declared as int: it is an index")
            return elements(self.model, value.field, value.name).start
        if isinstance(default, Element) and isinstance(value, str):
            return elements(self.model, default.field, value).start
        width = getattr(kind, "_shape_", ())
        is_number = not width
        try:
            array = np.asarray(value, dtype=np.float64)  # Warp's own vectors, lists and tensors alike
        except (TypeError, ValueError) as error:
            raise ValueError(f"the parameter {name}={value!r} of {self.name!r} is no number: {error}") from error
        if np.isnan(array).any():
            raise ValueError(f"the parameter {name}={value!r} of {self.name!r} is not a number")
        if isinstance(default, Element):
            count = self._places(default.field)
            if ((array < 0) | (array >= count)).any():
                raise ValueError(
                    f"the parameter {name}={value!r} of {self.name!r} is an index of {default.field!r}, of which the "
                    f"model has {count}: give one from 0 to {count - 1}, or a name"
                )
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

    def _places(self, field: str) -> int:
        """How many places a field has, of which an index names one."""
        if field not in self._sizes:
            self._sizes[field] = len(getattr(mujoco.MjData(self.model), field))
        return self._sizes[field]

    def _instance(self, world: int) -> Any:
        instance = self.params_struct()
        for name, value in self.params.items():
            kind = self.params_struct.vars[name].type
            if isinstance(value, np.ndarray):
                value = kind(*value[world].ravel()) if getattr(kind, "_shape_", ()) else kind(value[world])
            setattr(instance, name, value)
        return instance

    def explained(self, error: Exception) -> Exception:
        """What went wrong when the functions were compiled, in one line, where that is what went wrong."""
        text = str(error)
        if "while parsing function" not in text and not type(error).__module__.startswith("warp"):
            return error
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        return ValueError(f"Warp can't compile the functions of the task {self.name!r}: {' '.join(lines[-3:])}")

    def check_field(self, name: str, array: wp.array) -> None:
        """Compare the declaration of a field in World with the array that it will be bound to, (nworld, ...).

        Raises:
            ValueError: They differ in type or in axes.
        """
        kind = self.fields[name]
        dtype, ndim = (kind.dtype, kind.ndim) if hasattr(kind, "ndim") else (kind, 0)
        if not wp.types.types_equal(dtype, array.dtype) or ndim != array.ndim - 1:
            element = "lw.vec10" if array.dtype is vec10 else wp.types.type_repr(array.dtype)
            wanted = _SPELLED.get(element, element) if array.ndim == 1 else f"Row[{_SPELLED.get(element, element)}]"
            raise ValueError(f"World.{name} of the task {self.name!r} has to be declared as {wanted}")

    def check_observation(self, batch: Any, params: wp.array) -> None:
        """Let ``observe`` write into a row with room to spare, where otherwise it would spoil other memory unseen.

        Raises:
            ValueError: It writes more or less than ``obs`` declares.
        """
        nobs = sum(self.obs_layout.values())
        device = params.device
        mask = wp.full(1, True, dtype=bool, device=device)
        written = np.zeros(nobs + 64, dtype=bool)
        for unwritten in (math.nan, _UNWRITTEN):
            row = wp.full((1, nobs + 64), unwritten, dtype=float, device=device)
            wp.launch(self.kernels.look, 1, [mask, batch, params, row], device=device)
            found = row.numpy()[0]
            written |= ~np.isnan(found) if math.isnan(unwritten) else found != np.float32(unwritten)
        if written[nobs:].any():
            last = int(np.flatnonzero(written).max()) + 1
            raise ValueError(f"observe of the task {self.name!r} writes {last} numbers, but obs declares {nobs}")
        if not written[:nobs].all():
            places = np.flatnonzero(~written[:nobs]).tolist()
            raise ValueError(f"observe of the task {self.name!r} leaves the places {places} of obs unwritten")
        if np.isnan(found[:nobs]).any():
            places = np.flatnonzero(np.isnan(found[:nobs])).tolist()
            raise ValueError(f"observe of the task {self.name!r} makes the places {places} of obs not a number (NaN)")

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
