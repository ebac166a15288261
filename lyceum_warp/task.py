"""Task: what a user writes, and how its functions become kernels."""

import difflib
import importlib
import importlib.util
import linecache
import pkgutil
import re
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np
import warp as wp

from lyceum_warp import models
from lyceum_warp.fields import elements
from lyceum_warp.validate import whole_number

if TYPE_CHECKING:
    T = TypeVar("T")

    class Row(Generic[T]):
        """One world's values of a field; inside a kernel, a one-dimensional Warp array."""

        shape: tuple[int, ...]

        def __getitem__(self, i: int) -> T: ...
        def __setitem__(self, i: int, value: T) -> None: ...
        def __len__(self) -> int: ...
else:
    Row = wp.array

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


class Element(int):
    """The place of a named element of the model, found when the model is known. See ``site`` and its like."""

    field: str
    name: str

    def __new__(cls, field: str, name: str) -> "Element":
        element = super().__new__(cls, -1)
        element.field, element.name = field, name
        return element


def site(name: str) -> int:
    """As a default in Params: the index of a site, in ``site_xpos`` and its like."""
    return Element("site_xpos", name)


def body(name: str) -> int:
    """As a default in Params: the index of a body, in ``xpos`` and its like."""
    return Element("xpos", name)


def geom(name: str) -> int:
    """As a default in Params: the index of a geom, in ``geom_xpos`` and its like."""
    return Element("geom_xpos", name)


def qpos(joint: str) -> int:
    """As a default in Params: where a joint's coordinates begin in ``qpos``."""
    return Element("qpos", joint)


def dof(joint: str) -> int:
    """As a default in Params: where a joint's degrees of freedom begin in ``qvel`` and its like."""
    return Element("qvel", joint)


def sensor(name: str) -> int:
    """As a default in Params: where a sensor's numbers begin in ``sensordata``."""
    return Element("sensordata", name)


def mocap(body: str) -> int:
    """As a default in Params: the index of a mocap body, in ``mocap_pos`` and ``mocap_quat``."""
    return Element("mocap_pos", body)


class Task:
    """A model, the fields that are read, and a few functions of one world.

    A subclass names its model and the parts of its observation. Its module holds two Warp structs, ``World``
    (the fields that the functions read, by MuJoCo's names) and ``Params`` (the keyword arguments of ``make``,
    with defaults), and the functions, each a ``wp.func``. Either may also be an attribute of the class.

    =============================================== =====================================================
    ``observe(s, p, obs)``                          fills the observation; the only one that is required
    ``reward(s0, action, s1, p) -> float``          of one transition; default 0
    ``evaluate(s, p) -> float``                     the evaluation metric; default: the reward
    ``terminated(s, p) -> bool``                    default False
    ``success(s, p) -> bool``                       default False
    ``control(s, action, p, ctrl)``                 action to controls; default: copy (see ``action_range``)
    ``initialize(s, p)``                            changes the fixed initial state, the model's own
    ``randomize(s, p, rng)``                        turns the fixed initial state into a random one
    ``advance(s0, action, s1, p, rng)``             the only writer of task memory, ``s1.memory``
    =============================================== =====================================================

    Controls are clipped to the model's ranges; costs see the action as given. ``rng`` is drawn from with
    ``uniform`` and ``normal``. ``initialize`` and ``randomize`` may write qpos, qvel, act, mocap_pos,
    mocap_quat, userdata and memory where ``World`` lists them.
    """

    model: ClassVar[Any]
    """A file (relative to the task's own file, or one that gymnasium ships), an MjSpec, or a static method
    without arguments that makes one."""
    frame_skip: ClassVar[int] = 1
    """Physics substeps in a step."""
    obs: ClassVar[Any]
    """The observation's parts and their sizes, in order; or a static method of the Params that gives them."""
    horizon: ClassVar[int] = 1000
    """Steps after which an episode is truncated; 0 for never."""
    lagged: ClassVar[tuple[str, ...]] = ()
    """Fields wanted as ``mj_step`` leaves them, one substep behind the state, as in some Gymnasium tasks."""
    memory: ClassVar[int] = 0
    """Floats that the task remembers, in the field ``memory``."""
    action_range: ClassVar[tuple[float, float] | None] = None
    """The range of an action that the default ``control`` maps to the model's control ranges; None: actions
    are controls."""


# registration

_tasks: dict[str, type[Task]] = {}


def register(task: type[Task]) -> type[Task]:
    """Class decorator: make a task known by its name, the class name in snake_case.

    A class of the same file may take the place of the one before: a file is run again in a notebook, or both
    imported and given as a path.

    Raises:
        ValueError: Another task has the name.
    """
    name = task_name(task)
    known = _tasks.get(name)
    if known is None and not task.__module__.startswith(_PACKAGE) and name in _package_tasks():
        owner = f"{_PACKAGE}{name}"
    elif known is not None and known.__module__ != task.__module__ and _file(known) != _file(task):
        owner = f"{known.__module__}.{known.__qualname__}"
    else:
        _tasks[name] = task
        return task
    raise ValueError(f"the task name {name!r} is taken by {owner}: rename yours")


_PACKAGE = "lyceum_warp.tasks."


def _package_tasks() -> list[str]:
    package = importlib.import_module("lyceum_warp.tasks")
    return [module.name for module in pkgutil.iter_modules(package.__path__)]


def _file(task: type[Task]) -> str | None:
    file = getattr(sys.modules.get(task.__module__), "__file__", None)
    return file and str(Path(file).resolve())


def task_name(task: type[Task]) -> str:
    """The name under which a task is registered: HalfCheetah is half_cheetah."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", task.__name__).lower()


def tasks() -> list[str]:
    """Names of all tasks: those of the package and those registered by the user."""
    return sorted({*_tasks, *_package_tasks()})


def find_task(task: str | type[Task]) -> type[Task]:
    """The class of a task, by name, by file (``path/to/file.py`` or ``path/to/file.py:Class``), or itself.

    Raises:
        ValueError: There is no such task.
        FileNotFoundError: There is no such file.
    """
    if isinstance(task, type) and issubclass(task, Task):
        return task
    if not isinstance(task, str):
        raise ValueError(f"a task is a name, a file or a subclass of lw.Task, not {task!r}")
    path, _, attribute = task.partition(":")
    if path.endswith(".py"):
        return _task_of_file(Path(path), attribute)
    if task not in _tasks and importlib.util.find_spec(f"lyceum_warp.tasks.{task}") is not None:
        importlib.import_module(f"lyceum_warp.tasks.{task}")
    if task not in _tasks:
        close = difflib.get_close_matches(task, tasks(), 3)
        hint = f"did you mean {' or '.join(close)}?" if close else f"there are {', '.join(tasks())}"
        raise ValueError(f"there is no task {task!r}: {hint} (a task of your own is given as path/to/file.py)")
    return _tasks[task]


def _task_of_file(path: Path, attribute: str) -> type[Task]:
    if not path.is_file():
        raise FileNotFoundError(f"there is no task file {str(path)!r}")
    name = f"lyceum_task_{path.stem}_{zlib.crc32(str(path.resolve()).encode()):08x}"
    module = sys.modules.get(name)
    if module is None:
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    found = {
        key: value
        for key, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, Task) and value.__module__ == name
    }
    if attribute:
        if attribute not in found:
            raise ValueError(f"{path} has no task {attribute!r}; it has {', '.join(found) or 'none'}")
        return found[attribute]
    if len(found) != 1:
        raise ValueError(f"{path} has {len(found)} tasks ({', '.join(found)}): name one, as in {path}:Name")
    return next(iter(found.values()))


# from a class to kernels


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
        self.world_struct: Any = self._struct("World", required=True)
        self.params_struct: Any = self._struct("Params", required=False)
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

    def _struct(self, name: str, *, required: bool) -> Any:
        struct = getattr(self.task, name, None) or getattr(self.module, name, None)
        if struct is None and not required:
            return _NoParams
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

    def params_array(self, device: wp.Device) -> wp.array:
        """The parameters as the kernels read them: one entry, or one a world where any differs."""
        differ = any(isinstance(value, np.ndarray) for value in self.params.values())
        instances = [self._instance(w) for w in range(self.nworld if differ else 1)]
        return wp.array(instances, dtype=self.params_struct, device=device)


@wp.struct
class _NoParams:
    dt: float


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
    from lyceum_warp.kernels import steps  # here, because it imports nothing of this module but is large

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


__all__ = ["BoundTask", "Row", "Task", "find_task", "register", "tasks"]
