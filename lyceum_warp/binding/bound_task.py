"""Bind a task to its model and its parameters, and make its kernels."""

import keyword
import math
from collections.abc import Collection, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.binding import models, parts
from lyceum_warp.binding.codegen import kernels_of
from lyceum_warp.binding.divisions import check_divisions
from lyceum_warp.binding.functions import TaskSource, draws_noise
from lyceum_warp.binding.parameters import Parameters
from lyceum_warp.binding.registry import task_name
from lyceum_warp.binding.sources import is_struct, overloads
from lyceum_warp.binding.writes import Rights, check_reads, check_writes, written_fields
from lyceum_warp.core.fields import DATA_FIELDS, INITIAL, INPUTS, Field, describe, is_data_field, vec10
from lyceum_warp.core.model_fields import VARYING_FIELDS, describe_model_field, is_model_field
from lyceum_warp.core.options import ModelSource, PhysicsOptions
from lyceum_warp.core.spaces import OWN_PARTS
from lyceum_warp.core.task import FUNCTIONS, MEMORIES, RESULTS, Row, Task, TaskFunction, observer_name
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.support.validate import whole_number

_SPELLED = {
    "float32": "float", "int32": "int", "vec3f": "wp.vec3", "vec4f": "lw.quat", "mat33f": "wp.mat33",
    "spatial_vectorf": "wp.spatial_vector",
}  # fmt: skip

_MOST_SUCCESS_STEPS = 2**24
"""The steps are counted in a float32, which is exact up to 2**24."""

_BEFORE_FORWARD = {"startup", "initialize", "randomize"}
"""Functions that run before the engine computes the fields of the initial state."""

_PARTS = 'the parts of its observation, as obs = {"position": 5}'


def task_spec(task: type[Task], model: ModelSource | None = None) -> mujoco.MjSpec:
    """Load a task's model, or the given model, as an MjSpec, and apply ``edit_model`` of the task and its parents."""
    return _edited(task, _read_spec(task, model))


def _read_spec(task: type[Task], model: ModelSource | None) -> mujoco.MjSpec:
    if model is not None:
        return models.load_spec(model)
    if not hasattr(task, "model"):
        name = task_name(task)
        raise ValueError(f'the task {name!r} has no model: add one to its class, such as model = "robot.xml"')
    return models.load_spec(task.model() if callable(task.model) else task.model, task)


def _edited(task: type[Task], spec: mujoco.MjSpec) -> mujoco.MjSpec:
    copy, name = spec.copy(), task_name(task)
    edits = [vars(owner)["edit_model"] for owner in reversed(task.__mro__) if "edit_model" in vars(owner)]
    for edit in (edit.__get__(None, task) for edit in edits):
        if "edit_model" in getattr(getattr(edit, "__code__", None), "co_names", ()):
            raise ValueError(
                f"edit_model of the task {name!r} calls edit_model of another class, which would then run twice: "
                "remove the call, because the edits of all parents run first"
            )
        try:
            changed: Any = edit(copy)
        except Exception as error:
            raise ValueError(
                f"edit_model of the task {name!r} fails on the model {spec.modelname!r}: {type(error).__name__}: "
                f"{error}"
            ) from error
        if changed is not None:
            raise ValueError(
                f"edit_model of the task {name!r} returns {type(changed).__name__}: it must change the spec in place "
                "and return None"
            )
    return copy


def check_field_name(name: str) -> None:
    """Raise ValueError unless MjData or MjModel has a field of this name."""
    if is_data_field(name) or is_model_field(name):
        return
    hint = did_you_mean(name, [*DATA_FIELDS, *VARYING_FIELDS], "fields have MuJoCo's names, of MjData and MjModel")
    raise ValueError(f"there is no field {name!r}: {hint}")


def obs_layouts(source: TaskSource, params: Mapping[str, Any]) -> dict[str, dict[str, int]]:
    """Compute the layout of each observation group from the task's parameters."""
    task, name = source.definition, source.name
    if not hasattr(task, "obs"):
        return {group: parts.sizes(slices) for group, slices in obs_slices(source, params).items()}
    given = task.obs(SimpleNamespace(**params)) if callable(task.obs) else task.obs
    if not isinstance(given, Mapping) or not given:
        raise ValueError(f"obs of the task {name!r} is {given!r}: add {_PARTS}")
    grouped = [isinstance(part, Mapping) for part in given.values()]
    if not any(grouped):
        given = {"policy": given}
    elif not all(grouped) or "policy" not in given:
        raise ValueError(
            f"obs of the task {name!r} must be a dict of parts and sizes, or a dict of such dicts for groups, "
            f"including 'policy', not {given!r}"
        )
    for group in given:
        if not (isinstance(group, str) and group.isidentifier()) or keyword.iskeyword(group):
            raise ValueError(
                f"obs of the task {name!r} has the group {group!r}: a group's name must be a Python name, such as "
                "'critic', whose function is observe_critic"
            )
    return {group: _layout(name, layout) for group, layout in given.items()}


def obs_slices(source: TaskSource, params: Mapping[str, Any]) -> dict[str, parts.Layout]:
    """Compute the layouts of observation groups that are declared as structs."""
    if hasattr(source.definition, "obs"):
        return {}
    found = {}
    for group, struct in source.group_structs().items():
        if not is_struct(struct):
            raise ValueError(
                f"the task {source.name!r} has no obs: add {_PARTS} to its class, or let {observer_name(group)} take a "
                "struct of parts"
            )
        found[group] = parts.layout(struct, "obs", params, struct.key)
        if others := [name for name in struct.vars if name not in found[group]]:
            raise ValueError(
                f"{struct.key}.{others[0]} of the task {source.name!r} has no size: for three numbers, write "
                f"{others[0]}: Row[float] = lw.part(3)"
            )
        if not found[group]:
            raise ValueError(
                f"the struct {struct.key} of the task {source.name!r} has no parts, such as x: Row[float] = lw.part()"
            )
    return found


def _layout(task: str, layout: Mapping[str, Any]) -> dict[str, int]:
    if per_world := [name for name, size in layout.items() if np.ndim(size)]:
        raise ValueError(
            f"obs of the task {task!r} has sizes that differ between worlds, {per_world}: give one size for all worlds"
        )
    return {name: int(size) for name, size in layout.items() if size}


class BoundTask:
    """A task with its compiled model, its parameters and its kernels.

    Args:
        fields: More fields for the engine to provide. It always provides the fields of ``World``.
        dynamics: Model fields that may differ between worlds, besides those that the task writes.
        params: Values for the fields of ``Params``: one value, or one value per world.
    """

    def __init__(
        self,
        task: type[Task],
        nworld: int = 1,
        *,
        model: ModelSource | None = None,
        fields: Collection[str] = (),
        dynamics: Collection[str] = (),
        physics: PhysicsOptions | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> None:
        physics = physics or PhysicsOptions()
        self.definition = task
        """The task's class."""
        self.nworld = nworld
        self.name = task_name(task)
        self.source = TaskSource(task, self.name)
        self.functions = self.source.functions
        self.metrics = self.source.terms.metrics
        """The names of all metrics: the reward terms, the task's ``metrics``, the terminations and the truncations."""
        self._check_class()
        memory = self.source.memory
        own_names = [*memory, *(["shared"] if self.source.shared is not None else [])]
        named = [name for name in dict.fromkeys([*self.source.world.vars, *fields]) if name not in own_names]
        for name in named:
            check_field_name(name)
        self.types = {name: v.type for name, v in self.source.world.vars.items() if name not in own_names}
        self.types |= {name: Row[float] for name in MEMORIES if any(part.kind == name for part in memory.values())}
        self.writes = self._checked_writes()
        """What each function writes: fields of World and rows of memory."""
        own = [name for name in named if is_data_field(name)]
        of_model = [name for name in named if name not in own]
        self.spec = _read_spec(task, model)
        """The model before ``edit_model``."""
        edited, given = _edited(task, self.spec), task.model if model is None else model
        try:
            self.model = models.compile_model(edited, own, physics, varied={*of_model, *dynamics})
        except ValueError as error:
            file = given if isinstance(given, str | Path) else getattr(given, "file", None)
            raise ValueError(f"{file or f'the model of the task {self.name!r}'}: {error}") from error
        skip = task.frame_skip if physics.frame_skip is None else physics.frame_skip
        self.frame_skip = whole_number(f"frame_skip of the task {self.name!r}", skip, low=1)
        self.timestep: float = self.model.opt.timestep * self.frame_skip
        inputs = self.writes.get("control", frozenset())
        self.fields: list[Field] = [
            describe(self.model, name, lagged=name in task.lagged, cleared=name in task.cleared, written=name in inputs)
            for name in dict.fromkeys([*own, "time", "ctrl"])
        ]
        self._sort_model_fields(of_model, dynamics)
        self.initial = None if task.keyframe is None else models.keyframe_state(self.model, task.keyframe)
        """The state at which a reset starts, (integration_size,) float64."""
        self.parameters = Parameters(
            self.source.params, self.source.defaults, self.name, self.model, nworld=nworld, timestep=self.timestep,
            given=params or {}, weights=self.source.terms.weights,
        )  # fmt: skip
        self.actions = self._checked_actions()
        """The size of each part of an action, or None if the actions are MuJoCo's controls."""
        self.memory = self._memory_layouts()
        """The layouts of ``memory`` and ``lasting_memory``."""
        self.obs_layouts = obs_layouts(self.source, self.params)
        self.observers = self.source.group_functions(self.obs_layouts)
        observers = {observer_name(group): function for group, function in self.observers.items()}
        self._check_functions(observers, dict.fromkeys(observers, self._rights(FUNCTIONS["observe"])))
        self.shared = self._shared_layouts()
        structs = obs_slices(self.source, self.params) | self.shared
        self.kernels = kernels_of(self.source, self.observers, self.memory, structs)

    @property
    def params(self) -> dict[str, Any]:
        """The values of the parameters. A parameter that differs between worlds is an array."""
        return self.parameters.values

    def ends_by(self, function: str) -> bool:
        """Whether the task can end an episode by its function ``terminated`` or ``truncated``, written or generated."""
        return self.functions[function] is not None or function in self.source.terms.combined

    @property
    def reward_text(self) -> str:
        """The generated source of the reward, the metrics and the terminations."""
        return self.source.terms.text

    @property
    def noisy_groups(self) -> list[str]:
        """The observation groups whose functions draw random numbers."""
        return [group for group, function in self.observers.items() if draws_noise(function)]

    def _checked_writes(self) -> dict[str, frozenset[str]]:
        written = {name: function for name, function in self.functions.items() if function is not None}
        rights: dict[str, Rights] = {name: self._rights(function) for name, function in FUNCTIONS.items()}
        self._check_functions(written, rights)
        for name in _BEFORE_FORWARD & written.keys():
            check_reads(self.name, name, written[name])
        for name, function in self.source.terms.functions.items():
            for overload in overloads(function):  # a term must not write a field
                own = {name: dict.fromkeys(overload.input_types, ())}
                self._check_functions({name: overload}, rights | own)
        memory = self.source.memory
        fields = {name: written_fields(function) for name, function in written.items()}
        trained = frozenset[str]().union(*(names for name, names in fields.items() if name != "startup"))
        self.curriculum = tuple(name for name in memory if memory[name].kind == "lasting_memory" and name in trained)
        """Names of the lasting memory that functions other than ``startup`` write."""
        return {
            name: frozenset(memory[field].kind if field in memory else field for field in names)
            for name, names in fields.items()
        }

    def _check_functions(self, functions: Mapping[str, wp.Function], rights: Mapping[str, Rights]) -> None:
        check_writes(self.name, functions, rights)
        for name, function in functions.items():
            check_divisions(self.name, name, function)

    def _memory_layouts(self) -> dict[str, parts.Layout]:
        return {name: parts.layout(self.source.world, name, self.params, "World") for name in MEMORIES}

    def _shared_layouts(self) -> dict[str, parts.Layout]:
        structs = {"Shared": self.source.shared, "Sums": self.source.sums}
        return {
            name: parts.layout(struct, "obs", self.params, name)
            for name, struct in structs.items()
            if struct is not None
        }

    def _rights(self, function: TaskFunction) -> Rights:
        """Return which fields of each argument a function may write."""
        model = [name for name in self.types if is_model_field(name)]
        memory = tuple(self.source.memory)
        lasting = (*(name for name, part in self.source.memory.items() if part.kind == "lasting_memory"), *model)
        groups = {"inputs": INPUTS, "memory": memory, "lasting": lasting, "start": (*INITIAL, *memory, *model)}
        return {
            name: None if name in RESULTS else groups.get(function.writes.get(name, ""), ())
            for name in function.argument_names
        }

    def _sort_model_fields(self, named: list[str], dynamics: Collection[str]) -> None:
        drawn = {name: self.writes.get(name, frozenset()) for name in ("startup", "initialize", "randomize", "event")}
        between = drawn["initialize"] | drawn["randomize"] | drawn["event"]
        self.reset_dynamics = [name for name in named if name in between]
        """The model fields that resets or events write. A reset first restores their nominal values."""
        if both := [name for name in self.reset_dynamics if name in drawn["startup"]]:
            raise ValueError(
                f"the model field {both[0]!r} of the task {self.name!r} is written by startup and by resets or "
                "events: write it in one of them"
            )
        written = frozenset().union(dynamics, *drawn.values())
        varied = [name for name in dict.fromkeys([*named, *dynamics]) if name in written]
        self.dynamics = [describe_model_field(self.model, name) for name in varied]
        self.constants = [describe_model_field(self.model, name, varies=False) for name in named if name not in varied]
        """The model fields that functions read and that have the same value in all worlds."""
        drawn_constants = [field.name for field in self.dynamics if field.constants]
        if drawn_constants and (stale := [field.name for field in self.constants if field.follows]):
            raise ValueError(
                f"the task {self.name!r} reads {stale[0]!r}, but its value stays the same when a world changes "
                f"{drawn_constants[0]!r}: read the fields from which MuJoCo computes {stale[0]}"
            )

    def change_params(self, params: Mapping[str, Any]) -> None:
        """Change parameters."""
        previous, self.parameters = self.parameters, self.parameters.changed(params)
        try:
            changed = "the observation's" if obs_layouts(self.source, self.params) != self.obs_layouts else ""
        except ValueError:  # the size of a part would differ between worlds
            changed = "the observation's"
        layouts = (self._memory_layouts(), self._shared_layouts())
        changed = changed or ("the memory's" if layouts != (self.memory, self.shared) else "")
        if changed:
            self.parameters = previous
            raise ValueError(f"{', '.join(params)} would change the sizes of {changed} parts: make a new environment")

    def _check_class(self) -> None:
        task = self.definition
        for name in self.source.memory:
            if is_data_field(name) or is_model_field(name) or name in OWN_PARTS:
                raise ValueError(
                    f"the memory World.{name} of the task {self.name!r} has the name of an existing field or part of "
                    "the state: rename it"
                )
        for name in ("draws", "settle", "horizon"):
            self._check_int(name, low=1 if name == "draws" else 0)
        if not isinstance(task.keyframe, str | None):
            raise ValueError(
                f"keyframe of the task {self.name!r} must be the name of a keyframe of the model, such as 'home', not "
                f"{task.keyframe!r}"
            )
        self._check_metrics()
        for kind in ("lagged", "cleared"):
            for name in getattr(task, kind):
                if name not in self.source.world.vars:
                    raise ValueError(f"{kind} of the task {self.name!r} has {name!r}: make it a field of World, too")
        self._check_success_steps()
        if task.action_range is not None:
            try:
                low, high = map(float, task.action_range)
            except (TypeError, ValueError):
                low = high = math.nan
            if not -math.inf < low < high < math.inf:
                raise ValueError(
                    f"action_range of the task {self.name!r} must be two finite numbers, lowest first, such as (-1.0, "
                    f"1.0), not {task.action_range!r}"
                )

    def _check_int(self, name: str, **bounds: int) -> int:
        value, what = getattr(self.definition, name), f"{name} of the task {self.name!r}"
        number = whole_number(what, value, **bounds)
        if isinstance(value, float):
            raise ValueError(f"{what} must be an int: write {number}, not {value!r}")
        return number

    def _check_success_steps(self) -> None:
        task, name = self.definition, f"success_steps of the task {self.name!r}"
        steps = self._check_int("success_steps", low=1, high=_MOST_SUCCESS_STEPS)
        if steps > 1 and self.functions["success"] is None:
            raise ValueError(
                f"{name} is {steps}, but the task has no {FUNCTIONS['success'].signature}: add this function"
            )
        if steps > task.horizon > 0:
            raise ValueError(
                f"{name} is {steps}, but an episode has only {task.horizon} steps, so no episode can succeed: lower "
                "success_steps, or raise horizon"
            )

    def _check_metrics(self) -> None:
        metrics = self.metrics
        if bad := [name for name in metrics if not name.isprintable() or not set(name).isdisjoint(",'\"")]:
            raise ValueError(
                f"the task {self.name!r} has the metric {bad[0]!r}: a metric's name heads a column of metrics.csv, so "
                "it must have no comma, quote or line break"
            )
        if twice := [name for name in metrics if metrics.count(name) > 1]:
            raise ValueError(f"the task {self.name!r} names the metric {twice[0]!r} twice: give each one name")
        if self.functions["measure"] is not None and not self.definition.metrics:
            raise ValueError(
                f"the task {self.name!r} has {FUNCTIONS['measure'].signature}, but its class does not name its "
                "metrics: add metrics = (...)"
            )

    def _checked_actions(self) -> dict[str, int] | None:
        actions = self.definition.actions
        if actions is None:
            if self.model.nu == 0:
                raise ValueError(
                    f"the model of the task {self.name!r} has no actuators: add actuators, or give the task "
                    "actions = {...} and a control function that writes inputs"
                )
            return None
        if not isinstance(actions, Mapping) or not actions:
            raise ValueError(
                f"actions of the task {self.name!r} must be a dict of names and sizes, such as {{'speed': 1}}, not "
                f"{actions!r}"
            )
        if self.functions["control"] is None:
            raise ValueError(
                f"the task {self.name!r} defines its own actions, so it needs {FUNCTIONS['control'].signature}"
            )
        return {
            name: parts.length(f"the size of the action {name!r} of the task {self.name!r}", size, self.params)
            for name, size in actions.items()
        }

    def check_field(self, name: str, array: wp.array) -> None:
        """Check that the engine's array of a field, (nworld, ...), fits the type that World declares."""
        kind = self.types[name]
        dtype, ndim = (kind.dtype, kind.ndim) if hasattr(kind, "ndim") else (kind, 0)
        if not wp.types.types_equal(dtype, array.dtype) or ndim != array.ndim - 1:
            wanted = _spelled(array.dtype, array.ndim - 1)
            raise ValueError(f"World.{name} of the task {self.name!r} must be declared as {wanted}")

    def declaration(self, name: str) -> str:
        """Return the line of World that declares a field of the model, such as "qvel: Row[float]"."""
        if is_data_field(name):
            field = describe(self.model, name)
            return f"{name}: {_spelled(field.dtype, len(field.shape))}"
        constant = describe_model_field(self.model, name, varies=False)
        return f"{name}: {_spelled(constant.dtype, len(constant.shape))}"


def _spelled(dtype: Any, ndim: int) -> str:
    element = "lw.vec10" if dtype is vec10 else wp.types.type_repr(dtype)
    element = _SPELLED.get(element, element)
    return f"Row[{element}]" if ndim else element
