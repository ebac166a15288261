"""Find the parts of a forward pass that fields and sensors need."""

from collections.abc import Collection

import mujoco
import mujoco_warp as mjw

from lyceum_warp.engines.warp.substep import Part, inertia
from lyceum_warp.fields import Stage

_NEEDS: dict[Part, tuple[Part, ...]] = {
    mjw.kinematics: (),
    mjw.com_pos: (mjw.kinematics,),
    mjw.camlight: (mjw.com_pos,),
    mjw.flex: (mjw.com_pos,),
    mjw.tendon: (mjw.com_pos,),
    inertia: (mjw.com_pos, mjw.tendon),
    mjw.transmission: (mjw.com_pos, mjw.tendon),
    mjw.com_vel: (mjw.com_pos,),
    mjw.fwd_velocity: (mjw.com_pos, mjw.flex, mjw.tendon, mjw.transmission),
    mjw.subtree_vel: (mjw.com_vel,),
}
"""The parts without collisions and constraints, in their order, and what each needs; ``fwd_velocity`` has ``com_vel``
in it."""

_FIELDS: dict[Part, str] = {
    mjw.kinematics: "xpos xquat xmat xipos ximat xanchor xaxis geom_xpos geom_xmat site_xpos site_xmat",
    mjw.com_pos: "subtree_com cdof cinert",
    mjw.camlight: "cam_xpos cam_xmat light_xpos light_xdir",
    mjw.flex: "flexvert_xpos flexedge_length",
    mjw.tendon: "ten_length",
    inertia: "crb",
    mjw.transmission: "actuator_length",
    mjw.com_vel: "cvel cdof_dot",
    mjw.fwd_velocity: "ten_velocity actuator_velocity qfrc_bias qfrc_spring qfrc_damper qfrc_gravcomp qfrc_fluid "
    "qfrc_passive",
    mjw.subtree_vel: "subtree_linvel subtree_angmom",
}
"""The fields that each part computes."""

_PART_OF = {name: part for part, names in _FIELDS.items() for name in names.split()}

_SENSORS: dict[str, tuple[Part, ...]] = {
    "JOINTPOS BALLQUAT JOINTVEL BALLANGVEL CLOCK": (),
    "MAGNETOMETER FRAMEPOS FRAMEQUAT FRAMEXAXIS FRAMEYAXIS FRAMEZAXIS INSIDESITE": (mjw.kinematics,),
    "RANGEFINDER": (mjw.kinematics, mjw.flex),
    "SUBTREECOM": (mjw.com_pos,),
    "CAMPROJECTION": (mjw.camlight,),
    "TENDONPOS": (mjw.tendon,),
    "ACTUATORPOS": (mjw.transmission,),
    "E_POTENTIAL": (mjw.kinematics, mjw.flex, mjw.tendon),
    "E_KINETIC": (inertia,),
    "VELOCIMETER GYRO FRAMELINVEL FRAMEANGVEL SUBTREELINVEL SUBTREEANGMOM": (mjw.com_vel,),
    "TENDONVEL ACTUATORVEL": (mjw.fwd_velocity,),
}
"""What sensors of the position and velocity stages need, by their types; those of other types need a forward pass."""

_PARTS_OF_SENSOR = {
    int(getattr(mujoco.mjtSensor, f"mjSENS_{kind}")): parts
    for kinds, parts in _SENSORS.items()
    for kind in kinds.split()
}


def forward_parts(model: mujoco.MjModel, names: Collection[str]) -> tuple[Part, ...] | None:
    """The parts of a forward pass that compute the named fields, in order, without collisions and constraints.

    Of ``sensordata`` the parts compute the sensors of the position and velocity stages.

    Args:
        model: The compiled model.
        names: The fields.

    Returns:
        The parts, or None if the fields need collisions or constraints.
    """
    wanted: set[Part] = set()
    for name in names:
        if name != "sensordata" and name not in _PART_OF:
            return None
        wanted.update(() if name == "sensordata" else (_PART_OF[name],))
    sensors: list[Part] = []
    if "sensordata" in names:
        needed = _parts_of_sensors(model)
        if needed is None:
            return None
        wanted |= needed
        sensors = [mjw.sensor_pos, mjw.sensor_vel][: int(_last_stage(model))]
    for part in reversed(_NEEDS):
        if part in wanted:
            wanted.update(_NEEDS[part])
    if mjw.fwd_velocity in wanted:
        wanted.discard(mjw.com_vel)
    if _touching(model) and wanted & {mjw.transmission, mjw.fwd_velocity}:
        return None
    return (*(part for part in _NEEDS if part in wanted), *sensors)


def _parts_of_sensors(model: mujoco.MjModel) -> set[Part] | None:
    """The parts that the sensors of the position and velocity stages need, or None."""
    wanted: set[Part] = set()
    camera = int(mujoco.mjtObj.mjOBJ_CAMERA)
    for i in range(model.nsensor):
        if model.sensor_needstage[i] >= Stage.ACCELERATION:
            continue
        parts = _PARTS_OF_SENSOR.get(int(model.sensor_type[i]))
        if parts is None:
            return None
        wanted.update(parts)
        if camera in (model.sensor_objtype[i], model.sensor_reftype[i]):
            wanted.add(mjw.camlight)
    return wanted


def _last_stage(model: mujoco.MjModel) -> Stage:
    """The last stage before the acceleration that a sensor belongs to."""
    stages = [int(stage) for stage in model.sensor_needstage if stage < Stage.ACCELERATION]
    return Stage(max(stages, default=0))


def _touching(model: mujoco.MjModel) -> bool:
    """Whether contacts act on actuators or passive forces: adhesion, and contacts of a flex that are springs."""
    by_body = (model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_BODY)).any()
    return bool(by_body or model.flg_adhesion or model.flex_passive.any())
