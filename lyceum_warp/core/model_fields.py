"""Describe the model fields that can differ between worlds, and the constants that follow from them."""

import dataclasses
import enum
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import torch
import warp as wp

from lyceum_warp.core.fields import ELEMENT_TYPES, element_type
from lyceum_warp.support.validate import described


class Constants(enum.IntFlag):
    """Groups of constants that MuJoCo computes from other fields of a model (mj_setConst)."""

    NONE = 0
    FIXED = 1
    """Subtree masses and geom bounds."""
    KINEMATIC = 2
    """Tendon lengths, anchors of equality constraints and camera poses at ``qpos0``."""
    INERTIAL = 4
    """Inverse weights and unit accelerations at ``qpos0``."""
    PRIVATE = 8
    """Constants that only the C engine uses, such as bounding volumes of bodies."""


_ALL = Constants.FIXED | Constants.KINEMATIC | Constants.INERTIAL | Constants.PRIVATE
_POSES = Constants.KINEMATIC | Constants.INERTIAL | Constants.PRIVATE
_WRAPPED = {"geom_pos", "geom_quat", "geom_size"}
"""Geom fields that affect tendons wrapped around the geom."""

_WRAPS = [int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER)]

PICTURED = ("cam_fovy", "geom_rgba", "mat_rgba", "light_ambient", "light_diffuse")
"""Fields that can differ between worlds and affect only pictures."""

VARYING_FIELDS = (
    dict.fromkeys(
        # contacts
        "geom_friction geom_solmix geom_solref geom_solimp "
        "pair_friction pair_solref pair_solreffriction pair_solimp pair_margin pair_gap "
        # joints
        "jnt_solref jnt_solimp jnt_stiffness jnt_range jnt_actfrcrange jnt_margin "
        "dof_solref dof_solimp dof_frictionloss dof_damping "
        # equalities and tendons
        "eq_solref eq_solimp "
        "tendon_solref_lim tendon_solimp_lim tendon_solref_fri tendon_solimp_fri tendon_range tendon_actfrcrange "
        "tendon_margin tendon_frictionloss tendon_lengthspring "
        # actuators and options
        "actuator_dynprm actuator_gainprm actuator_biasprm actuator_actrange actuator_forcerange "
        "gravity magnetic".split(),
        Constants.NONE,
    )
    | dict.fromkeys(
        "body_gravcomp geom_pos geom_quat geom_margin geom_gap qpos_spring tendon_stiffness tendon_damping "
        "actuator_damping wind density viscosity".split(),
        Constants.PRIVATE,
    )
    | dict.fromkeys(
        "qpos0 body_pos body_quat body_ipos body_iquat body_inertia jnt_pos jnt_axis site_pos site_quat dof_armature "
        "tendon_armature actuator_armature actuator_gear actuator_cranklength".split(),
        _POSES,
    )
    | dict.fromkeys(("cam_pos", "cam_quat"), Constants.KINEMATIC | Constants.PRIVATE)
    | dict.fromkeys(PICTURED, Constants.NONE)
    | {"body_mass": _ALL, "geom_size": Constants.FIXED | Constants.PRIVATE}
)
"""Fields that can differ between worlds, each with the constants that follow from it."""

MESH_FIELDS = ("geom_dataid", "geom_aabb", "geom_rbound")
OBJECT_FIELDS = ("object", *MESH_FIELDS)
"""Fields that differ between worlds only if the worlds hold different objects. ``object`` is the object's index, which
is no field of MjModel."""

SEEN = {*PICTURED, *MESH_FIELDS} | set(
    "qpos0 body_pos body_quat jnt_pos jnt_axis geom_pos geom_quat geom_size cam_pos cam_quat".split()
)
"""Fields that can differ between worlds and that pictures show."""

_OPTIONS = {"gravity", "magnetic", "wind", "density", "viscosity"}

_COMPUTED = set(
    "body_subtreemass body_invweight0 dof_invweight0 dof_M0 tendon_invweight0 tendon_length0 actuator_acc0 "
    "actuator_length0 geom_rbound geom_aabb cam_pos0 cam_poscom0 cam_mat0 light_pos0 light_poscom0 light_dir0 "
    "eq_data".split()
)

_REASONS = (
    dict.fromkeys(
        _COMPUTED,
        "MuJoCo computes it from other fields; write those instead",
    )
    | {"timestep": "all worlds share it; the parameters dt and substep_dt have the seconds of a step and a substep",
       "impratio": "MuJoCo Warp stores a number computed from it instead"}
    | dict.fromkeys(("geom_surfacevel", "geom_adhesion", "pair_adhesion"),
                    "MuJoCo Warp decides on the host whether any geom has it")
    | dict.fromkeys(("actuator_ctrlrange", "actuator_ctrllimited"), "controls are clipped to the model's own ranges")
)  # fmt: skip

_POSITIVE = {"body_mass", "body_inertia", "geom_size"}
"""Fields that must be positive if their nominal values are positive."""

NOT_NEGATIVE = _POSITIVE | set(
    "geom_friction pair_friction jnt_stiffness dof_damping dof_armature dof_frictionloss tendon_stiffness "
    "tendon_damping tendon_armature tendon_frictionloss actuator_damping actuator_armature density viscosity".split()
)
"""Fields that must not be negative."""


@dataclasses.dataclass(frozen=True)
class ModelField:
    """A model field that can differ between worlds."""

    name: str
    shape: tuple[int, ...]
    """Shape of the field in one world. A vector or quaternion counts as one element."""
    dtype: type
    """Warp type of an element: float, wp.vec3, wp.vec4 for quaternions (w, x, y, z), ..."""
    constants: Constants
    rows: np.ndarray | None = dataclasses.field(default=None, compare=False, repr=False)
    """The values of each object, (objects, size), float64; None if the field does not depend on the object."""

    @property
    def size(self) -> int:
        """Number of scalars of the field in one world."""
        return int(np.prod(self.shape, dtype=int)) * wp.types.type_size_in_bytes(self.dtype) // 4

    @property
    def option(self) -> bool:
        """Whether the field is an attribute of MjModel.opt."""
        return self.name in _OPTIONS

    @property
    def in_model(self) -> bool:
        """Whether the field is a field of MjModel, not the index of the world's object."""
        return self.name != "object"

    @property
    def follows(self) -> bool:
        """Whether MuJoCo computes the field from other fields."""
        return self.name in _COMPUTED

    def problem(self, model: mujoco.MjModel, rows: np.ndarray) -> str | None:
        """Describe the first invalid value, or return None."""
        nominal = self.nominal(model).min(axis=0)
        bad = ~np.isfinite(rows)
        if self.name in NOT_NEGATIVE:
            bad |= (rows < 0) | ((rows == 0) & (nominal > 0) & (self.name in _POSITIVE))
        if not bad.any():
            return None
        world, column = np.argwhere(bad)[0].tolist()
        place = np.unravel_index(column, self.value(model).shape) if nominal.size > 1 else ()
        index = "".join(f"[{int(i)}]" for i in place)
        wanted = "0 or more" if self.name in NOT_NEGATIVE else "finite"
        if self.name in _POSITIVE and nominal[column] > 0:
            wanted = "positive"
        return (
            f"{self.name}{index} of world {world} is {rows[world, column]:g} and must be {wanted} "
            f"(its nominal value is {nominal[column]:g})"
        )

    def value(self, model: mujoco.MjModel) -> np.ndarray:
        """Get this field's value in a model, in float64. An array is returned as a view."""
        if self.name == "object":
            return np.zeros(1)
        return np.asarray(getattr(model.opt if self.option else model, self.name))

    def nominal(self, model: mujoco.MjModel) -> np.ndarray:
        """Get the nominal values, (objects, size), float64; (1, size) if they do not depend on the object."""
        return self.value(model).reshape(1, -1).astype(np.float64) if self.rows is None else self.rows


def put_rows(model: mujoco.MjModel, values: Mapping[str, Any], columns: Mapping[str, torch.Tensor]) -> None:
    """Write values of model fields into a batch of states."""
    for name, value in values.items():
        field = describe_model_field(model, name)
        if name not in columns:
            raise ValueError(
                f"the model field {name!r} is the same in every world of this environment: make the environment with "
                f"dynamics=[{name!r}], or let the task write the field"
            )
        target = columns[name]
        try:
            numbers = value if isinstance(value, torch.Tensor) else np.asarray(value)
            rows = torch.as_tensor(numbers, dtype=torch.float64, device=target.device)
            target.copy_(rows.reshape(-1, target.shape[1]))
        except (TypeError, ValueError, RuntimeError):
            shape = field.value(model).shape or (1,)
            shapes = f"{(len(target), *shape)}, or {shape} for all worlds"
            raise ValueError(f"{name} must be numbers of shape {shapes}, not {described(value)}") from None


def is_model_field(name: str) -> bool:
    """Return whether MjModel or MjModel.opt has an attribute of this name."""
    return name == "object" or hasattr(mujoco.MjModel, name) or hasattr(mujoco.MjOption, name)


def describe_model_field(
    model: mujoco.MjModel, name: str, *, varies: bool = True, rows: np.ndarray | None = None
) -> ModelField:
    """Describe a field of a model; ``rows`` has the values of each object."""
    if name == "object":
        return ModelField(name, (1,), wp.float32, Constants.NONE, rows)
    if not varies and name not in VARYING_FIELDS:
        value: Any = getattr(model, name, None)
        numbers = isinstance(value, np.ndarray) and value.dtype == np.float64
        if not numbers or value.ndim > 2 or (value.ndim == 2 and value.shape[1] not in ELEMENT_TYPES):
            reason = _REASONS[name] if name == "timestep" else "it has no rows of real numbers; make it a parameter"
            raise ValueError(f"the model field {name!r} cannot be read in World: {reason}")
        return ModelField(name, value.shape[:1], element_type(value.shape), Constants.NONE)
    if name not in VARYING_FIELDS and rows is None:
        shared = "the engines share it between all worlds" if is_model_field(name) else "it is no field of MjModel"
        raise ValueError(f"the field {name!r} cannot differ between worlds: {_REASONS.get(name, shared)}")
    constants = VARYING_FIELDS.get(name, Constants.PRIVATE)
    if name in _WRAPPED and np.isin(model.wrap_type, _WRAPS).any():
        constants |= _POSES
    # a task can write a scalar only as an array of one element
    shape: tuple[int, ...] = np.shape(getattr(model.opt if name in _OPTIONS else model, name)) or (1,)
    return ModelField(name, shape[:1], element_type(shape), constants, rows)


MOVED_INERTIA = {"body_ipos", "body_iquat"}
"""Fields that move a body's inertial frame. They cannot differ between worlds for bodies that MuJoCo compiled as
"simple". In such a body, the inertial frame is the body frame."""
