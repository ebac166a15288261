"""Bind a task to its model and its parameters, and make its kernels."""

import contextlib
import copy
import functools
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import warp as wp

from lyceum_warp.binding import models
from lyceum_warp.binding.attributes import check_attributes
from lyceum_warp.binding.codegen import kernels_of
from lyceum_warp.binding.functions import TaskSource, draws_noise
from lyceum_warp.binding.layouts import layouts_of
from lyceum_warp.binding.parameters import Parameters
from lyceum_warp.binding.registry import task_name
from lyceum_warp.core.cameras import Camera, cameras_of
from lyceum_warp.core.fields import Field, describe, is_data_field, vec10
from lyceum_warp.core.fitted import Fitted
from lyceum_warp.core.model_fields import MOVED_INERTIA, describe_model_field
from lyceum_warp.core.model_files import ModelSource, read_task_spec
from lyceum_warp.core.options import PhysicsOptions
from lyceum_warp.core.task import MEMORIES, Task
from lyceum_warp.models.objects import ObjectModels

_SPELLED = {
    "float32": "float", "int32": "int", "vec3f": "wp.vec3", "vec4f": "lw.quat", "mat33f": "wp.mat33",
    "spatial_vectorf": "wp.spatial_vector",
}  # fmt: skip


class BoundTask:
    """A task with its compiled model, its parameters and its kernels.

    Args:
        fields: More fields for the engine to provide. It always provides the fields of ``World``.
        dynamics: Model fields that may differ between worlds, besides those that the task writes.
        params: Values for the fields of ``Params``: one value, or one value per world.
        fitted: Folder of a fit.
        fitted_draws: Whether the fitted fields may differ between worlds.
        cameras: Cameras whose pictures are observations; None for those of the task.
        objects: Names of the objects that worlds hold; None for the task's default.
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
        fitted: str | None = None,
        fitted_draws: bool = False,
        cameras: Collection[Camera] | None = None,
        objects: Collection[str] | None = None,
    ) -> None:
        physics = physics or PhysicsOptions()
        self.definition = task
        """The task's class."""
        self.nworld = nworld
        self.source = source = TaskSource(task)
        check_attributes(source, (*fields, *dynamics))
        self.functions, self.types = source.functions, source.types
        self.metrics, self.curriculum = source.terms.metrics, source.curriculum
        self.writes = source.writes
        """What each function writes: fields of World and rows of memory."""
        self.cameras = cameras_of(task.cameras if cameras is None else cameras)
        """The cameras whose pictures are observations."""
        if self.cameras:
            fields = [*fields, "qpos", "mocap_pos", "mocap_quat"]
        names = [name for name in dict.fromkeys([*self.types, *fields]) if name not in MEMORIES]
        data_fields = [name for name in names if is_data_field(name)]
        model_fields = [name for name in names if not is_data_field(name)]

        self.spec = read_task_spec(task, model)
        """The model before ``edit_model``."""
        edited = models.edited(task, self.spec)
        self.fit = None if fitted is None else Fitted(fitted)
        """The fit whose values the model has."""
        fields_of_fit = tuple(self.fit.values) if self.fit else ()
        dynamics = (*dynamics, *fields_of_fit) if fitted_draws else dynamics
        if self.fit:
            self.fit.delay(edited, physics.timestep or edited.option.timestep)
        varied = {*model_fields, *dynamics, *fields_of_fit}
        objects_in_model = self._put_objects(edited, objects)
        if len(self.objects) > 1:
            varied |= MOVED_INERTIA
        for camera in self.cameras:
            camera.add_to(edited)
        with _file_in_errors(task.model if model is None else model):
            self.nominal = models.compile_model(
                edited, data_fields, physics, varied=varied, keep_meshes=bool(self.objects)
            )
            """The compiled model without the values of a fit."""
        self.model = self.nominal
        if self.fit:
            self.model = copy.copy(self.nominal)
            self.fit.put(self.model)
        if physics.timestep is not None or physics.integrator is not None:
            models.warn_of_unstable_servos(self.model)
        self.frame_skip = task.frame_skip if physics.frame_skip is None else physics.frame_skip
        self.timestep: float = self.model.opt.timestep * self.frame_skip
        self.initial = None if task.keyframe is None else models.keyframe_state(self.model, task.keyframe)
        """The state at which a reset starts, (integration_size,) float64."""
        if self.model.nu == 0 and task.actions is None:
            raise ValueError(
                "the model has no actuators: add actuators, or give the task actions = {...} and a control function "
                "that writes inputs"
            )
        inputs = self.writes["control"]
        self.fields: list[Field] = [
            describe(self.model, name, lagged=name in task.lagged, cleared=name in task.cleared, written=name in inputs)
            for name in dict.fromkeys([*data_fields, "time", "ctrl"])
        ]
        rows = {} if objects_in_model is None else objects_in_model.rows(self.model)
        self._describe_model_fields(model_fields, dynamics, rows)
        if fitted_draws and (both := sorted(rows.keys() & set(fields_of_fit))):
            raise ValueError(f"fitted_draws=True draws {both[0]}, which differs between objects: name one object")
        self.parameters = Parameters(source, self.nominal, params or {}, nworld=nworld, timestep=self.timestep)
        self.layouts = layouts_of(source, self.params)
        if taken := [camera for camera in self.cameras if camera.group in self.layouts.obs]:
            raise ValueError(
                f"the camera {taken[0].name!r} needs another group: the task's group {taken[0].group!r} has numbers"
            )
        self.kernels = kernels_of(source, self.layouts)

    def _put_objects(self, spec: mujoco.MjSpec, names: Collection[str] | None) -> ObjectModels | None:
        """Put the objects into a spec, unless the worlds keep the geoms of the model."""
        declared = self.definition.objects
        self.objects: dict[str, int] = {}
        """The objects that worlds hold, each with its index."""
        if declared is None:
            if names is not None:
                raise ValueError(f"objects={list(names)} needs a task that declares objects: omit it, or give the task "
                                 "objects = lw.Objects(...)")  # fmt: skip
            return None
        if names is None and (body := spec.body(declared.body)) is not None and body.geoms:
            return None
        self.objects = declared.chosen(names)
        return ObjectModels(spec, declared, self.objects, self.definition)

    def _describe_model_fields(
        self, model_fields: Collection[str], dynamics: Collection[str], rows: Mapping[str, np.ndarray]
    ) -> None:
        drawn = self.source.drawn_between_steps
        self.redraws = bool(rows) and self.definition.objects.redraw  # type: ignore[union-attr]
        """Whether a random reset draws another object."""
        changed = drawn | rows.keys() if self.redraws else drawn
        self.reset_dynamics = [name for name in dict.fromkeys([*model_fields, *rows]) if name in changed]
        """The model fields that resets or events write. A reset first restores their nominal values."""
        if once := sorted(changed & self.writes["startup"] & rows.keys()):
            raise ValueError(f"startup writes {once[0]}, which a reset changes with the object: write it in randomize")
        varied = drawn | self.writes["startup"] | frozenset(dynamics) | rows.keys()
        self.dynamics = [
            describe_model_field(self.model, name, rows=rows.get(name))
            for name in dict.fromkeys([*model_fields, *dynamics, *rows])
            if name in varied
        ]
        self.constants = [
            describe_model_field(self.model, name, varies=False) for name in model_fields if name not in varied
        ]
        """The model fields that functions read and that have the same value in all worlds."""
        bases = [field.name for field in self.dynamics if field.constants]
        if bases and (stale := [field.name for field in self.constants if field.follows]):
            raise ValueError(
                f"World.{stale[0]} stays the same when a world changes {bases[0]!r}: read the fields from which MuJoCo "
                f"computes {stale[0]}"
            )

    @functools.cached_property
    def name(self) -> str:
        """The task's name."""
        return task_name(self.definition)

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
        return [group for group, function in self.layouts.observers.items() if draws_noise(function)]

    def change_params(self, params: Mapping[str, Any]) -> None:
        """Change parameters."""
        previous, self.parameters = self.parameters, self.parameters.changed(params)
        try:
            changes = layouts_of(self.source, self.params) != self.layouts
        except ValueError:  # the size of a part would differ between worlds
            changes = True
        if changes:
            self.parameters = previous
            raise ValueError(
                f"{', '.join(params)} would change the sizes of observations or memory: make a new environment"
            )

    def check_field(self, name: str, array: wp.array) -> None:
        """Check that the engine's array of a field, (nworld, ...), fits the type that World declares."""
        kind = self.types[name]
        dtype, ndim = (kind.dtype, kind.ndim) if hasattr(kind, "ndim") else (kind, 0)
        if not wp.types.types_equal(dtype, array.dtype) or ndim != array.ndim - 1:
            wanted = _spelled(array.dtype, array.ndim - 1)
            raise ValueError(f"World.{name} must be declared as {wanted}")

    def declaration(self, name: str) -> str:
        """Return the line of World that declares a field of the model, such as "qvel: Row[float]"."""
        data = is_data_field(name)
        field = describe(self.model, name) if data else describe_model_field(self.model, name, varies=False)
        return f"{name}: {_spelled(field.dtype, len(field.shape))}"


@contextlib.contextmanager
def _file_in_errors(model: Any) -> Iterator[None]:
    """Put the file of a model in front of a ValueError."""
    try:
        yield
    except ValueError as error:
        file = model if isinstance(model, str | Path) else getattr(model, "file", None)
        raise ValueError(f"{file or 'the model'}: {error}") from error


def _spelled(dtype: Any, ndim: int) -> str:
    element = "lw.vec10" if dtype is vec10 else wp.types.type_repr(dtype)
    element = _SPELLED.get(element, element)
    return f"Row[{element}]" if ndim else element
