"""The simulator's fields: the stage that computes each, its Warp type, and how it stays current."""

import dataclasses
import difflib
import enum

import mujoco
import numpy as np
import warp as wp

vec10 = wp.types.vector(length=10, dtype=wp.float32)


class Stage(enum.IntEnum):
    """A stage of a forward pass; the values are those of mjtStage."""

    NONE = 0
    POSITION = 1
    VELOCITY = 2
    ACCELERATION = 3


STATE_FIELDS = {
    "time": mujoco.mjtState.mjSTATE_TIME,
    "qpos": mujoco.mjtState.mjSTATE_QPOS,
    "qvel": mujoco.mjtState.mjSTATE_QVEL,
    "act": mujoco.mjtState.mjSTATE_ACT,
    "qacc_warmstart": mujoco.mjtState.mjSTATE_WARMSTART,
    "ctrl": mujoco.mjtState.mjSTATE_CTRL,
    "qfrc_applied": mujoco.mjtState.mjSTATE_QFRC_APPLIED,
    "xfrc_applied": mujoco.mjtState.mjSTATE_XFRC_APPLIED,
    "mocap_pos": mujoco.mjtState.mjSTATE_MOCAP_POS,
    "mocap_quat": mujoco.mjtState.mjSTATE_MOCAP_QUAT,
    "userdata": mujoco.mjtState.mjSTATE_USERDATA,
}
"""Fields that are part of the integration state, with their mjtState component."""

INPUTS = ("ctrl", "xfrc_applied", "qfrc_applied", "mocap_pos", "mocap_quat", "userdata")
"""State fields that physics reads and does not change: a task may write them before a step."""

_POSITION = (
    "xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat cam_xpos cam_xmat "
    "light_xpos light_xdir subtree_com cdof cinert ten_length actuator_length crb"
)
_VELOCITY = (
    "cvel cdof_dot ten_velocity actuator_velocity qfrc_bias qfrc_spring qfrc_damper qfrc_gravcomp qfrc_fluid "
    "qfrc_passive subtree_linvel subtree_angmom"
)
_ACCELERATION = (
    "act_dot actuator_force qfrc_actuator qfrc_smooth qacc_smooth qfrc_constraint qacc cacc cfrc_int cfrc_ext"
)
DERIVED_FIELDS = (
    dict.fromkeys(_POSITION.split(), Stage.POSITION)
    | dict.fromkeys(_VELOCITY.split(), Stage.VELOCITY)
    | dict.fromkeys(_ACCELERATION.split(), Stage.ACCELERATION)
)
"""Fields that a forward pass computes, with the stage that computes them."""

ON_DEMAND = {
    "cacc": mujoco.mjtSensor.mjSENS_FRAMELINACC,
    "cfrc_int": mujoco.mjtSensor.mjSENS_FRAMELINACC,
    "cfrc_ext": mujoco.mjtSensor.mjSENS_FRAMELINACC,
    "subtree_linvel": mujoco.mjtSensor.mjSENS_SUBTREELINVEL,
    "subtree_angmom": mujoco.mjtSensor.mjSENS_SUBTREEANGMOM,
}
"""Fields that MuJoCo leaves at zero unless a sensor of the model needs them, with the type of such a sensor."""

SENSED = {"sensordata", *ON_DEMAND}
"""Fields for which the model's sensors must be enabled."""

_TYPES = {3: wp.vec3, 4: wp.quat, 6: wp.spatial_vector, 9: wp.mat33, 10: vec10}

# the kind of object along a field's first axis, by the prefix of the field's name
_OBJECTS = {
    "ten": mujoco.mjtObj.mjOBJ_TENDON,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "cam": mujoco.mjtObj.mjOBJ_CAMERA,
    "light": mujoco.mjtObj.mjOBJ_LIGHT,
}


_COUNTS = {
    mujoco.mjtObj.mjOBJ_ACTUATOR: "nu",
    mujoco.mjtObj.mjOBJ_BODY: "nbody",
    mujoco.mjtObj.mjOBJ_CAMERA: "ncam",
    mujoco.mjtObj.mjOBJ_GEOM: "ngeom",
    mujoco.mjtObj.mjOBJ_JOINT: "njnt",
    mujoco.mjtObj.mjOBJ_LIGHT: "nlight",
    mujoco.mjtObj.mjOBJ_SENSOR: "nsensor",
    mujoco.mjtObj.mjOBJ_SITE: "nsite",
    mujoco.mjtObj.mjOBJ_TENDON: "ntendon",
}


@dataclasses.dataclass(frozen=True)
class Field:
    """One field of one model, and how the engine keeps it."""

    name: str
    shape: tuple[int, ...]
    """Shape of one world's value, without the axis that ``dtype`` holds."""
    dtype: type
    """Warp type of an element: float, wp.vec3, wp.quat (w, x, y, z as in MuJoCo), ..."""
    refresh: Stage
    """The stage that must be computed after a step for this field to belong to the new state."""
    reset: Stage
    """The stage that must be computed after a reset."""
    lagged: bool
    """Whether the field stays as ``mj_step`` leaves it, one substep behind the state."""
    snapshot: bool
    """Whether the field is not a function of the integration state, so that it is saved and restored with it."""
    written: bool = False
    """Whether the task writes the field before a step, which then takes it over: one of ``INPUTS``."""

    @property
    def size(self) -> int:
        """Floats in one world's value."""
        return int(np.prod(self.shape, dtype=int)) * wp.types.type_size_in_bytes(self.dtype) // 4


def describe(model: mujoco.MjModel, name: str, *, lagged: bool = False, written: bool = False) -> Field:
    """Describe a field of a model.

    Args:
        model: The compiled model.
        name: MuJoCo's name of the field, an attribute of MjData.
        lagged: Whether to keep the field as ``mj_step`` leaves it, one substep behind the state. Fields of the
            acceleration stage are always kept so; for a field of the integration state it has no effect.
        written: Whether the task writes the field before a step. Controls are always written.

    Raises:
        ValueError: There is no such field, the model has no enabled sensor that makes MuJoCo compute it, or it is
            written and not one of ``INPUTS``.
    """
    if written and name not in INPUTS:
        raise ValueError(f"the field {name!r} cannot be written before a step: the inputs are {', '.join(INPUTS)}")
    written = written or name == "ctrl"
    if name in SENSED and not _sensed(model, name):
        raise ValueError(
            f"MuJoCo computes the field {name!r} only for a sensor, and this model has no enabled sensor that needs "
            f"it: list the field in the task's World, or give make() fields=[{name!r}]"
        )
    if name in STATE_FIELDS:
        refresh = reset = Stage.NONE
        snapshot = lagged = False
    elif name == "sensordata":
        stages = set(int(stage) for stage in model.sensor_needstage)
        current = max(stages - {int(Stage.ACCELERATION)}, default=0)
        refresh, reset = Stage(0 if lagged else current), Stage(max(stages, default=0))
        snapshot = lagged or Stage.ACCELERATION in stages
    elif name in DERIVED_FIELDS:
        reset = DERIVED_FIELDS[name]
        lagged = lagged and reset < Stage.ACCELERATION
        snapshot = lagged or reset == Stage.ACCELERATION
        refresh = Stage.NONE if snapshot else reset
    else:
        known = [*STATE_FIELDS, *DERIVED_FIELDS, "sensordata"]
        close = difflib.get_close_matches(name, known, 3)
        hint = f"did you mean {' or '.join(close)}?" if close else f"the fields are {', '.join(sorted(known))}"
        raise ValueError(f"there is no field {name!r}: {hint}")
    shape: tuple[int, ...] = np.shape(getattr(mujoco.MjData(model), name))
    if len(shape) == 2:
        return Field(name, shape[:1], _TYPES[shape[1]], refresh, reset, lagged, snapshot, written)
    return Field(name, shape, wp.float32, refresh, reset, lagged, snapshot, written)


def state_columns(model: mujoco.MjModel, name: str) -> slice:
    """The columns of a state field in the integration state (mjSTATE_INTEGRATION)."""
    component = STATE_FIELDS[name].value
    start = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION.value & (component - 1))
    return slice(start, start + mujoco.mj_stateSize(model, component))


def _sensed(model: mujoco.MjModel, name: str) -> bool:
    """Whether a sensor of the model makes MuJoCo compute a field."""
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR:
        return False
    if name == "sensordata":
        return True
    kind = mujoco.mjtSensor
    if ON_DEMAND[name] == kind.mjSENS_FRAMELINACC:  # one pass serves all of these
        kinds = [kind.mjSENS_ACCELEROMETER, kind.mjSENS_FORCE, kind.mjSENS_TORQUE, kind.mjSENS_FRAMELINACC,
                 kind.mjSENS_FRAMEANGACC]  # fmt: skip
    else:
        kinds = [kind.mjSENS_SUBTREELINVEL, kind.mjSENS_SUBTREEANGMOM]
    return bool(np.isin(model.sensor_type, [int(k) for k in kinds]).any())


def elements(model: mujoco.MjModel, name: str, element: str) -> slice:
    """The place of a named element of the model in a field, along the axis after the worlds.

    A joint has its coordinates in ``qpos`` and its degrees of freedom in ``qvel``, ``qacc`` and other fields of that
    size, a sensor its numbers in ``sensordata``, a mocap body its row in ``mocap_pos``. In every other field each
    object has one row.

    Raises:
        ValueError: The model has no such element.
    """

    def find(kind: mujoco.mjtObj) -> int:
        index = mujoco.mj_name2id(model, kind, element)
        if index < 0:
            names = [mujoco.mj_id2name(model, kind, i) for i in range(getattr(model, _COUNTS[kind]))]
            kind_name = kind.name.removeprefix("mjOBJ_").lower()
            known = ", ".join(sorted(n for n in names if n)) or "none that are named"
            raise ValueError(f"the model has no {kind_name} {element!r} for the field {name!r}; it has: {known}")
        return index

    if name == "sensordata":
        i = find(mujoco.mjtObj.mjOBJ_SENSOR)
        return slice(int(model.sensor_adr[i]), int(model.sensor_adr[i] + model.sensor_dim[i]))
    if name == "qpos":
        i = find(mujoco.mjtObj.mjOBJ_JOINT)
        end = model.jnt_qposadr[i + 1] if i + 1 < model.njnt else model.nq
        return slice(int(model.jnt_qposadr[i]), int(end))
    if name in ("qvel", "qacc", "cdof", "cdof_dot", "qacc_warmstart", "qacc_smooth") or name.startswith("qfrc_"):
        i = find(mujoco.mjtObj.mjOBJ_JOINT)
        end = model.jnt_dofadr[i + 1] if i + 1 < model.njnt else model.nv
        return slice(int(model.jnt_dofadr[i]), int(end))
    if name in ("mocap_pos", "mocap_quat"):
        i = int(model.body_mocapid[find(mujoco.mjtObj.mjOBJ_BODY)])
        if i < 0:
            raise ValueError(f"the body {element!r} is not a mocap body, so it has no {name!r}")
        return slice(i, i + 1)
    prefix = name.partition("_")[0]
    if name == "ctrl":
        kind = mujoco.mjtObj.mjOBJ_ACTUATOR
    elif name in ("xanchor", "xaxis"):
        kind = mujoco.mjtObj.mjOBJ_JOINT
    elif name in ("time", "act", "act_dot", "userdata"):
        raise ValueError(f"the field {name!r} has no named elements")
    else:
        kind = _OBJECTS.get(prefix, mujoco.mjtObj.mjOBJ_BODY)
    i = find(kind)
    return slice(i, i + 1)
