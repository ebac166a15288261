"""A task bound to its model and its parameters, with its kernels."""

import math
import re
from collections.abc import Collection, Mapping
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.binding import models
from lyceum_warp.binding.codegen import kernels_of
from lyceum_warp.binding.functions import TaskSource
from lyceum_warp.binding.parameters import Parameters
from lyceum_warp.binding.registry import task_name
from lyceum_warp.fields import Field, describe, vec10
from lyceum_warp.options import ModelSource, PhysicsOptions
from lyceum_warp.task import FUNCTIONS, Task
from lyceum_warp.validate import whole_number

_SPELLED = {
    "float32": "float", "int32": "int", "vec3f": "wp.vec3", "vec4f": "lw.quat", "mat33f": "wp.mat33",
    "spatial_vectorf": "wp.spatial_vector",
}  # fmt: skip

_UNWRITTEN = 7.25e33
"""A number that no observation is likely to be."""

_MISSING = {"obs": 'the parts of its observation, as obs = {"position": 5}', "model": 'a model, as model = "robot.xml"'}


def task_spec(task: type[Task], model: ModelSource | None = None) -> mujoco.MjSpec:
    """A task's model, or another one that is given for it, editable; see ``models.load_spec``."""
    if model is not None:
        return models.load_spec(model)
    return models.load_spec(task.model() if callable(task.model) else task.model, task)


class BoundTask:
    """A task with its compiled model, its parameters and its kernels.

    Args:
        task: The task's class.
        nworld: Number of worlds, for parameters that differ between them.
        model: Another model than the task's own.
        fields: Fields that the engine keeps beside those of the task.
        physics: How the worlds are simulated.
        params: Values for the fields of ``Params``; for a scalar also one value a world.

    Raises:
        ValueError: Parts of the task, the parameters or the options do not fit together.
        FileNotFoundError: The model's file is missing.
    """

    def __init__(
        self,
        task: type[Task],
        nworld: int = 1,
        *,
        model: ModelSource | None = None,
        fields: Collection[str] = (),
        physics: PhysicsOptions | None = None,
        params: Mapping[str, Any] | None = None,
    ) -> None:
        physics = physics or PhysicsOptions()
        self.task, self.nworld = task, nworld
        self.name = task_name(task)
        self.source = TaskSource(task, self.name)
        self.functions = self.source.functions
        self.types = {name: variable.type for name, variable in self.source.world.vars.items()}
        self._check_class(model)
        own = [name for name in self.types if name != "memory"]
        spec = task_spec(task, model)
        self.model = models.compile_model(spec, [*own, *fields], physics)
        if self.model.nu == 0:
            raise ValueError(f"the model of the task {self.name!r} has no actuators, so there is nothing to act on")
        skip = task.frame_skip if physics.frame_skip is None else physics.frame_skip
        self.frame_skip = whole_number(f"frame_skip of the task {self.name!r}", skip, low=1)
        self.timestep: float = self.model.opt.timestep * self.frame_skip
        names = dict.fromkeys([*own, *fields, "time", "ctrl"])
        self.fields: list[Field] = [describe(self.model, name, lagged=name in task.lagged) for name in names]
        """The fields that the engine keeps: the task's own, further ones, time and controls."""
        self.parameters = Parameters(
            self.source.params, self.name, self.model, nworld=nworld, timestep=self.timestep, given=params or {}
        )
        self.obs_layout = self._layout()
        self.kernels = kernels_of(self.source)

    @property
    def params(self) -> dict[str, Any]:
        """The parameters' values by name; arrays where they differ between worlds."""
        return self.parameters.values

    def change_params(self, params: Mapping[str, Any]) -> None:
        """Change parameters.

        Raises:
            ValueError: There is no such parameter, or the observation would change its size.
        """
        previous = self.parameters.values
        self.parameters.values = self.parameters.checked(params)
        try:
            same = self._layout() == self.obs_layout
        except ValueError:  # one value a world, where the layout needs a single one
            same = False
        if not same:
            self.parameters.values = previous
            raise ValueError(f"{', '.join(params)} would change the observation's parts: make a new environment")

    def _check_class(self, model: ModelSource | None) -> None:
        task = self.task
        if ("memory" in self.types) != (task.memory > 0):
            raise ValueError(f"the task {self.name!r} needs both, memory = ... in the class and memory in World")
        for name in task.lagged:
            if name not in self.types:
                raise ValueError(f"the task {self.name!r} wants {name!r} lagged but does not list it in World")
        for name in ("obs", "model"):
            if not hasattr(task, name) and (name == "obs" or model is None):
                raise ValueError(f"the task {self.name!r} has no {name}: add {_MISSING[name]} to its class")
        whole_number(f"horizon of the task {self.name!r}", task.horizon, low=0)
        if task.action_range is not None:
            try:
                low, high = map(float, task.action_range)
            except (TypeError, ValueError):
                low = high = math.nan
            if not -math.inf < low < high < math.inf:
                raise ValueError(
                    f"action_range of the task {self.name!r} must be two finite numbers, lowest first, as (-1.0, 1.0), "
                    f"not {task.action_range!r}"
                )

    def _layout(self) -> dict[str, int]:
        """The observation's parts and their sizes, for the parameters as they are."""
        params = SimpleNamespace(**self.params)
        layout = self.task.obs(params) if callable(self.task.obs) else self.task.obs
        if not isinstance(layout, Mapping):
            raise ValueError(f"obs of the task {self.name!r} is {layout!r}: add {_MISSING['obs']}")
        if per_world := [name for name, size in layout.items() if np.ndim(size)]:
            raise ValueError(f"obs of the task {self.name!r} differs between worlds in {per_world}: give one value")
        return {name: int(size) for name, size in layout.items() if size}

    def explained(self, error: Exception) -> Exception:
        """An error in one line, where Warp could not compile the task's functions; other errors as they are."""
        text = str(error)
        if "while parsing function" not in text and not type(error).__module__.startswith("warp"):
            return error
        # which kernel is compiled first, and so which of its lines is in the message, differs from run to run
        flat = " ".join(text.split())
        call = re.search(r"\b(reward|evaluate|terminated|success)\((?:s0|s1|view)\b", flat)
        kind = re.search(r"value argument type \((.+?)\) must be|with different type \(<class '[\w.]*?(\w+)'>\)", flat)
        if call and kind:
            signature, returned = FUNCTIONS[call.group(1)].signature, kind.group(1) or kind.group(2)
            return ValueError(
                f"{call.group(1)} of the task {self.name!r} returns {returned}: it must be written as {signature}"
            )
        lines = [line.strip(" ;") for line in text.splitlines() if line.strip(" ;")]
        hint = ": a function returns one number, not a tuple" if "tuple_t" in text else ""
        if re.search(r"overload for '(quat\w*|mul)' .*\bvec4f\b", flat):
            hint = (
                ": quaternions are w, x, y, z here: use lw.quat_rotate, lw.quat_mul, ... in place of Warp's functions"
            )
        return ValueError(f"Warp can't compile the functions of the task {self.name!r}: {' '.join(lines[-3:])}{hint}")

    def check_field(self, name: str, array: wp.array) -> None:
        """Compare the declaration of a field in World with the array that it will be bound to, (nworld, ...).

        Raises:
            ValueError: They differ in type or in axes.
        """
        kind = self.types[name]
        dtype, ndim = (kind.dtype, kind.ndim) if hasattr(kind, "ndim") else (kind, 0)
        if not wp.types.types_equal(dtype, array.dtype) or ndim != array.ndim - 1:
            element = "lw.vec10" if array.dtype is vec10 else wp.types.type_repr(array.dtype)
            wanted = _SPELLED.get(element, element) if array.ndim == 1 else f"Row[{_SPELLED.get(element, element)}]"
            raise ValueError(f"World.{name} of the task {self.name!r} must be declared as {wanted}")

    def check_observation(self, batch: Any, params: wp.array) -> None:
        """Let ``observe`` write into a row with room to spare, where a mistake cannot damage other memory.

        Raises:
            ValueError: It writes more or fewer numbers than ``obs`` declares, or writes not-a-number.
        """
        nobs = sum(self.obs_layout.values())
        device = params.device
        mask = wp.full(1, True, dtype=bool, device=device)
        written = np.zeros(nobs + 64, dtype=bool)
        for unwritten in (math.nan, _UNWRITTEN):
            row = wp.full((1, nobs + 64), unwritten, dtype=float, device=device)
            wp.launch(self.kernels.observe_worlds, 1, [mask, batch, params, row], device=device)
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
            raise ValueError(f"observe of the task {self.name!r} writes not-a-number into the places {places} of obs")
