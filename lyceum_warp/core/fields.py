"""Describe the fields of MjData: their Warp types, and the stages that compute them."""

import dataclasses
import enum
from typing import Any

import mujoco
import numpy as np
import warp as wp

quat = wp.vec4
"""A quaternion in MuJoCo's order w, x, y, z. Do not pass a ``quat`` to Warp's quaternion functions, which expect the
order x, y, z, w."""

vec10 = wp.types.vector(length=10, dtype=wp.float32)


class Stage(enum.IntEnum):
    """Stages of a forward pass, with the values of mjtStage."""

    NONE = 0
    POSITION = 1
    VELOCITY = 2
    ACCELERATION = 3


STATE_FIELDS: dict[str, mujoco.mjtState] = {
    name: getattr(mujoco.mjtState, f"mjSTATE_{name.removeprefix('qacc_').upper()}")
    for name in "time qpos qvel act history plastic qacc_warmstart ctrl qfrc_applied xfrc_applied eq_active mocap_pos "
    "mocap_quat userdata".split()
}
"""Fields of the integration state, each with its mjtState component."""

INPUTS = ("ctrl", "xfrc_applied", "qfrc_applied", "mocap_pos", "mocap_quat", "userdata")
"""Fields of the state that the engine only reads. A task may write these fields before a step."""

INITIAL = ("qpos", "qvel", "act", "eq_active", *INPUTS)

READ_ONLY = ("history", "plastic")
"""Fields of the integration state that only the engine writes."""

_POSITION = (
    "xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat cam_xpos cam_xmat "
    "light_xpos light_xdir subtree_com cdof cinert flexvert_xpos flexedge_length ten_length actuator_length crb"
)
_VELOCITY = (
    "cvel cdof_dot flexedge_velocity ten_velocity actuator_velocity qfrc_bias qfrc_spring qfrc_damper qfrc_gravcomp "
    "qfrc_fluid qfrc_adhesion qfrc_passive subtree_linvel subtree_angmom energy"
)
_ACCELERATION = (
    "act_dot actuator_force qfrc_actuator qfrc_smooth qacc_smooth qfrc_constraint qacc cacc cfrc_int cfrc_ext"
)
DERIVED_FIELDS = (
    dict.fromkeys(_POSITION.split(), Stage.POSITION)
    | dict.fromkeys(_VELOCITY.split(), Stage.VELOCITY)
    | dict.fromkeys(_ACCELERATION.split(), Stage.ACCELERATION)
)
"""Fields that a forward pass computes, each with its stage."""

ON_DEMAND = {
    "cacc": mujoco.mjtSensor.mjSENS_FRAMELINACC,
    "cfrc_int": mujoco.mjtSensor.mjSENS_FRAMELINACC,
    "cfrc_ext": mujoco.mjtSensor.mjSENS_FRAMELINACC,
    "subtree_linvel": mujoco.mjtSensor.mjSENS_SUBTREELINVEL,
    "subtree_angmom": mujoco.mjtSensor.mjSENS_SUBTREEANGMOM,
}
"""Maps each field that MuJoCo computes only for sensors to the type of a sensor that needs it."""

SENSED = {"sensordata", *ON_DEMAND}
"""Fields that are computed only if the model's sensors are enabled."""

ELEMENT_TYPES = {
    2: wp.vec2, 3: wp.vec3, 4: quat, 5: wp.types.vector(length=5, dtype=wp.float32), 6: wp.spatial_vector, 9: wp.mat33,
    10: vec10,
}  # fmt: skip


def element_type(shape: tuple[int, ...]) -> Any:
    """Return the Warp type of the elements of a field, or raise KeyError if there is none."""
    return ELEMENT_TYPES[shape[1]] if len(shape) == 2 else wp.float32


_Kind = mujoco.mjtObj

_Rows = tuple[mujoco.mjtObj | None, str, str]

_ACTIVATIONS: _Rows = (_Kind.mjOBJ_ACTUATOR, "actuator_actadr", "actuator_actnum")

_FIELDS: dict[_Rows, str] = {
    (_Kind.mjOBJ_ACTUATOR, "", ""): "actuator",
    (_Kind.mjOBJ_BODY, "", ""): "body xpos xquat xmat xipos ximat cvel cacc cinert crb cfrc_int cfrc_ext xfrc_applied "
    "subtree_com subtree_linvel subtree_angmom",
    (_Kind.mjOBJ_CAMERA, "", ""): "cam",
    (_Kind.mjOBJ_EQUALITY, "", ""): "eq",
    (_Kind.mjOBJ_GEOM, "", ""): "geom",
    (_Kind.mjOBJ_JOINT, "", ""): "jnt xanchor xaxis",
    (_Kind.mjOBJ_LIGHT, "", ""): "light",
    (_Kind.mjOBJ_MATERIAL, "", ""): "mat",
    (_Kind.mjOBJ_PAIR, "", ""): "pair",
    (_Kind.mjOBJ_SENSOR, "", ""): "sensor",
    (_Kind.mjOBJ_SITE, "", ""): "site",
    (_Kind.mjOBJ_TENDON, "", ""): "ten tendon",
    (_Kind.mjOBJ_JOINT, "jnt_qposadr", "nq"): "qpos qpos0 qpos_spring",
    (_Kind.mjOBJ_JOINT, "jnt_dofadr", "nv"): "qvel qacc cdof cdof_dot qacc_warmstart qacc_smooth qfrc dof",
    (_Kind.mjOBJ_ACTUATOR, "actuator_ctrladr", "actuator_ctrlnum"): "ctrl actuator_ctrlrange actuator_ctrllimited",
    (_Kind.mjOBJ_ACTUATOR, "actuator_outadr", "actuator_outnum"): "actuator_length actuator_velocity actuator_force "
    "actuator_gear actuator_acc0 actuator_length0 actuator_lengthrange",
    _ACTIVATIONS: "act act_dot",
    (_Kind.mjOBJ_SENSOR, "sensor_adr", "sensor_dim"): "sensordata",
    (_Kind.mjOBJ_FLEX, "flex_vertadr", "flex_vertnum"): "flexvert_xpos",
    (_Kind.mjOBJ_FLEX, "flex_edgeadr", "flex_edgenum"): "flexedge_length flexedge_velocity",
}
"""Names or prefixes of the fields of objects: the type of the objects and, if an object may have several rows, the
fields with its first row and its number of rows."""

_ROWS = {name: rows for rows, names in _FIELDS.items() for name in names.split()}


@dataclasses.dataclass(frozen=True)
class Field:
    """One field of a model."""

    name: str
    shape: tuple[int, ...]
    """Shape of the field in one world. A vector or quaternion counts as one element."""
    dtype: type
    """Warp type of an element: float, wp.vec3, quat (w, x, y, z), ..."""
    refresh: Stage
    """The stage that updates the field after a step."""
    reset: Stage
    """The stage that updates the field after a reset, or ``Stage.NONE`` if the reset itself writes the field."""
    lagged: bool
    """Whether the field keeps the value from ``mj_step``, which is one substep older than the state."""
    snapshot: bool
    """Whether a state stores the field in addition to MuJoCo's integration state."""
    written: bool = False
    """Whether the task writes the field before a step."""

    @property
    def size(self) -> int:
        """Number of scalars of the field in a world."""
        return int(np.prod(self.shape, dtype=int)) * max(1, wp.types.type_size_in_bytes(self.dtype) // 4)


DATA_FIELDS = (*STATE_FIELDS, *DERIVED_FIELDS, "sensordata")
"""MjData fields that an environment can keep."""


def is_data_field(name: str) -> bool:
    """Return whether an environment can keep an MjData field of this name."""
    return name in STATE_FIELDS or name in DERIVED_FIELDS or name in SENSED


def describe(
    model: mujoco.MjModel, name: str, *, lagged: bool = False, cleared: bool = False, written: bool = False
) -> Field:
    """Describe a field of a model.

    Fields of the position and velocity stages always match the current state. Fields of the acceleration stage, such as
    ``qacc`` or ``cfrc_ext``, are those at the start of the last substep. In ``sensordata``, each sensor's columns
    belong to the sensor's stage. Fields of the acceleration stage always lag (``Field.lagged``), and fields of the
    integration state never do.
    """
    written = written or name == "ctrl"
    if name in SENSED and not _sensed(model, name):
        raise ValueError(
            f"MuJoCo computes the field {name!r} only for a sensor, and this model has no enabled sensor that needs "
            f"it: list the field in the task's World, or pass fields=[{name!r}] to make()"
        )
    if name in STATE_FIELDS:
        refresh = reset = Stage.NONE
        snapshot = lagged = False
    elif name == "sensordata":
        stages = set(int(stage) for stage in model.sensor_needstage)
        current = max(stages - {int(Stage.ACCELERATION)}, default=0)
        refresh, reset = Stage(0 if lagged else current), Stage(max(stages, default=0))
        snapshot = lagged or Stage.ACCELERATION in stages
    else:
        reset = DERIVED_FIELDS[name]
        lagged = lagged and reset < Stage.ACCELERATION
        snapshot = lagged or reset == Stage.ACCELERATION
        refresh = Stage.NONE if snapshot else reset
    if cleared:
        if name == "sensordata" and not snapshot:
            raise ValueError(
                "the task reads forces or accelerations from 'sensordata', because it lists it in cleared, but the "
                "model has no sensor of them: add the sensors in edit_model"
            )
        if not snapshot or refresh > Stage.NONE:
            raise ValueError(f"the field {name!r} belongs to the current state: remove it from cleared")
        reset = Stage.NONE
    shape: tuple[int, ...] = np.shape(getattr(mujoco.MjData(model), name))
    dtype = wp.bool if name == "eq_active" else element_type(shape)
    return Field(name, shape[:1], dtype, refresh, reset, lagged, snapshot, written)


def early_sensor_columns(model: mujoco.MjModel) -> np.ndarray:
    """Get the columns of ``sensordata`` that belong to the position and velocity stages, (n,) int."""
    early = np.flatnonzero(model.sensor_needstage < Stage.ACCELERATION)
    ranges = [np.arange(model.sensor_adr[i], model.sensor_adr[i] + model.sensor_dim[i]) for i in early]
    return np.concatenate([np.zeros(0, int), *ranges])


def state_columns(model: mujoco.MjModel, name: str) -> slice:
    """Get a field's columns in the integration state (mjSTATE_INTEGRATION)."""
    component = STATE_FIELDS[name].value
    start = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION.value & (component - 1))
    return slice(start, start + mujoco.mj_stateSize(model, component))


def _sensed(model: mujoco.MjModel, name: str) -> bool:
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR:
        return False
    if name == "sensordata":
        return True
    kind = mujoco.mjtSensor
    if ON_DEMAND[name] == kind.mjSENS_FRAMELINACC:  # MuJoCo computes accelerations and forces in the same pass
        kinds = [kind.mjSENS_ACCELEROMETER, kind.mjSENS_FORCE, kind.mjSENS_TORQUE, kind.mjSENS_FRAMELINACC,
                 kind.mjSENS_FRAMEANGACC]  # fmt: skip
    else:
        kinds = [kind.mjSENS_SUBTREELINVEL, kind.mjSENS_SUBTREEANGMOM]
    return bool(np.isin(model.sensor_type, [int(k) for k in kinds]).any())


def elements(model: mujoco.MjModel, name: str, element: str) -> slice:
    """Get the rows of a named element in a field of MjData or MjModel.

    An element may have several rows: a free joint, for example, has seven in ``qpos``.
    """
    if name in ("mocap_pos", "mocap_quat"):
        i = int(model.body_mocapid[_find(model, _Kind.mjOBJ_BODY, element)])
        if i < 0:
            raise ValueError(f"the body {element!r} is not a mocap body, so it has no {name!r}")
        return slice(i, i + 1)
    kind, starts, counts = _rows(name)
    if kind is None:
        raise ValueError(f"the field {name!r} has no named elements")
    i = _find(model, kind, element)
    if not starts:
        return slice(i, i + 1)
    first = getattr(model, starts)
    if counts in ("nq", "nv"):
        end = first[i + 1] if i + 1 < len(first) else getattr(model, counts)
    else:
        end = first[i] + getattr(model, counts)[i]
    if end == first[i] or first[i] < 0:
        raise ValueError(f"the {_called(kind)} {element!r} has no {name!r}")
    return slice(int(first[i]), int(end))


def _rows(name: str) -> _Rows:
    return _ROWS.get(name) or _ROWS.get(name.partition("_")[0]) or (None, "", "")


def has_several_rows(name: str) -> bool:
    """Return whether an object may have several rows in a field, such as a ball joint in ``cdof``."""
    return bool(_rows(name)[1])


def rows(model: mujoco.MjModel, name: str) -> int:
    """Get the length of a field along its elements' axis."""
    owner = model if hasattr(model, name) else mujoco.MjData(model)
    return len(getattr(owner, name))


def element_names(model: mujoco.MjModel, name: str) -> list[str]:
    """List the named elements of a field of MjData or MjModel, such as the joints of ``qvel``."""
    kind = _rows(name)[0]
    names = [mujoco.mj_id2name(model, kind, i) for i in range(model.nnames)] if kind is not None else []
    elements_of = [element for element in names if element]
    if _rows(name) == _ACTIVATIONS:
        return [element for element in elements_of if model.actuator(element).actadr[0] >= 0]
    return elements_of


def _called(kind: mujoco.mjtObj) -> str:
    return kind.name.removeprefix("mjOBJ_").lower()


def _find(model: mujoco.MjModel, kind: mujoco.mjtObj, element: str) -> int:
    index = mujoco.mj_name2id(model, kind, element)
    if index < 0:
        names = ", ".join(sorted(filter(None, (mujoco.mj_id2name(model, kind, i) for i in range(model.nnames)))))
        raise ValueError(f"the model has no {_called(kind)} {element!r}; it has: {names or 'none with names'}")
    return index
