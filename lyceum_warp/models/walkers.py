"""Find a walking robot's feet, joints and mirror image in its compiled model, and prepare models for walking.

Functions with the arguments ``(model, p)`` are for ``lw.from_model``. The parameters ``p.joints`` and ``p.feet`` are
indices of the joints and of the feet's sites. The base is the body of the first joint, which must be a free joint.
"""

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.core.mirror import Mirror

_JOINT, _SENSOR = mujoco.mjtObj.mjOBJ_JOINT, mujoco.mjtObj.mjOBJ_SENSOR
_CORNERS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_FORCE, _LARGEST, _NET = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 2, 3


# joints


def base(model: mujoco.MjModel, p: Any = None) -> int:
    """Get the base, which is the body of the free joint.

    Raises:
        ValueError: The first joint of the model is not free.
    """
    if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError("the first joint of the model is not a free joint, so there is no floating base")
    return int(model.jnt_bodyid[0])


def joint_qpos(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the index of each joint in ``qpos``, (joints,)."""
    return model.jnt_qposadr[p.joints]


def joint_dof(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the index of each joint in ``qvel``, (joints,)."""
    return model.jnt_dofadr[p.joints]


def servos(model: mujoco.MjModel, p: Any) -> list[int]:
    """Get the actuator of each joint, (joints,).

    Raises:
        ValueError: A joint does not have exactly one actuator.
    """
    moved = np.where(model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, model.actuator_trnid[:, 0], -1)
    matches = [np.flatnonzero(moved == joint) for joint in p.joints]
    for joint, actuators in zip(p.joints, matches, strict=True):
        if len(actuators) != 1:
            raise ValueError(
                f"the joint {_name(model, _JOINT, joint)} has {len(actuators)} actuators but needs exactly one "
                f"(tendon actuators do not count): change the model, or omit the joint from ``joints``"
            )
    return [int(actuators[0]) for actuators in matches]


def controls(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the index in ``ctrl`` of each joint's servo, (joints,)."""
    return model.actuator_ctrladr[servos(model, p)]


def quarter_of_force(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Compute mjlab's scale of actions, 0.25 * limit / kp, (joints,) in rad.

    This is a quarter of the position error at which a servo reaches its force limit.

    Raises:
        ValueError: A servo has no force limit.
    """
    limits = force_limits(model, p)
    if not limits.all():
        unlimited = _name(model, _JOINT, p.joints[int(np.argmin(limits))])
        raise ValueError(f"the servo of the joint {unlimited} has no force limit: pass action_scale, in rad")
    return 0.25 * limits / model.actuator_gainprm[servos(model, p), 0]


def force_limits(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the largest force of each joint's servo, (joints,) in N m. Joints without a limit get 0."""
    actuators = servos(model, p)
    return np.where(
        model.actuator_forcelimited[actuators], model.actuator_forcerange[actuators, 1],
        np.where(model.jnt_actfrclimited[p.joints], model.jnt_actfrcrange[p.joints, 1], 0.0),
    )  # fmt: skip


def home_qpos(model: mujoco.MjModel) -> np.ndarray:
    """Get the coordinates of the keyframe "home", or ``qpos0`` if there is none."""
    key = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, "home")
    return model.qpos0 if key < 0 else model.key_qpos[key]


def home_pose(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the positions of the joints in ``home_qpos``, (joints,) in rad."""
    return home_qpos(model)[joint_qpos(model, p)]


def home_height(model: mujoco.MjModel, p: Any) -> float:
    """Get the height of the base in ``home_qpos``, in m."""
    return float(home_qpos(model)[2])


def deployment(model: mujoco.MjModel, p: Any, memory: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Add the ranges of commands to ``base_metadata``, for ``lw.Task.deployment`` of velocity tasks.

    The ranges cover the curriculum's stages that training has reached.
    """
    stages = np.asarray(p.stages)
    stages = stages[stages[:, 0] <= max(memory["env_steps"].max(), stages[0, 0])]
    yaw, lateral = float(stages[:, 3].max()), float(np.max(p.lateral_velocity))
    clock = {"gait_frequency": float(p.gait_frequency)} if hasattr(p, "gait_frequency") else {}  # Hz
    commands = {
        "forward_velocity": [float(stages[:, 1].min()), float(stages[:, 2].max())],
        "lateral_velocity": [-lateral, lateral],
        "yaw_rate": [-yaw, yaw],
    }
    return clock | base_metadata(model, p) | {"commands": commands}


def servo_metadata(model: mujoco.MjModel, p: Any) -> dict[str, Any]:
    """Collect the names, gains and poses that a robot needs to run a policy. Lists are in the order of ``joints``."""
    actuators = servos(model, p)
    # the joint's own damping adds to the servo's damping
    damping = model.dof_damping[joint_dof(model, p)].reshape(len(actuators), -1)[:, 0]
    return {
        "joints": [model.joint(joint).name for joint in p.joints],
        "default_pose": np.asarray(p.default_pose).tolist(),
        "action_scale": np.asarray(p.action_scale).tolist(),
        "stiffness": model.actuator_gainprm[actuators, 0].tolist(),
        "damping": (damping - model.actuator_biasprm[actuators, 2]).tolist(),
        "force_limit": force_limits(model, p).tolist(),
    }


def base_metadata(model: mujoco.MjModel, p: Any) -> dict[str, Any]:
    """Add the floating base, and the velocimeter's position on it, in m, to ``servo_metadata``."""
    base_and_imu = {"base": model.body(base(model)).name, "velocimeter": np.asarray(p.imu).tolist()}
    return base_and_imu | servo_metadata(model, p)


def mirror(model: mujoco.MjModel, p: Any) -> Mirror:
    """Make the mirror image of a velocity task in the plane y = 0 of the base, for ``lw.Task.mirror``.

    A joint's partner is the corresponding joint on the other side, or the joint itself. With all joints at 0, positions
    and axes of partners must be mirror images. Masses need not be symmetric.

    Raises:
        ValueError: A joint or a foot has no partner, or the default pose or the scale of actions is not symmetric.
    """
    data, name = straight(model), functools.partial(_name, model, _JOINT)
    flip, spin = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0])
    hinges = np.arange(1, model.njnt)
    partner, sign = np.zeros(model.njnt, int), np.ones(model.njnt)
    for joint in hinges:
        distances = np.linalg.norm(data.xanchor[hinges] - flip * data.xanchor[joint], axis=1)
        cosines = data.xaxis[hinges] @ (spin * data.xaxis[joint])
        best = int(np.argmin(distances + (1.0 - np.abs(cosines))))
        if distances[best] > 0.005 or abs(cosines[best]) < 0.999:
            raise ValueError(f"the joint {name(joint)} has no mirror image on the other side of the robot")
        partner[joint], sign[joint] = hinges[best], np.sign(cosines[best])
    acting = [int(joint) for joint in p.joints]
    if alone := [joint for joint in acting if partner[joint] not in acting]:
        raise ValueError(
            f"the joint {name(alone[0])} is actuated, but its mirror image {name(partner[alone[0]])} is not"
        )
    joints = [acting.index(partner[joint]) for joint in acting], sign[acting]
    for table, signs in (("default_pose", joints[1]), ("action_scale", 1.0)):
        values = np.asarray(getattr(p, table))
        if (np.abs(values - signs * values[joints[0]]) > 1e-3).any():
            raise ValueError(f"{table} is not symmetric: {values.tolist()}")
    order = mirror_order(data.site_xpos[p.feet], [f"the foot's site {model.site(foot).name!r}" for foot in p.feet])
    feet, vectors = mirror_rows(order, [1.0]), mirror_rows(order, flip)
    maps: dict[str, Any] = {
        "linear_velocity": flip, "angular_velocity": spin, "gravity": flip, "command": (1.0, -1.0, -1.0),
        **dict.fromkeys(("joint_position", "joint_velocity", "last_action"), joints),
        "clock": (-1.0, -1.0),  # exchanging the legs shifts the clock's sine and cosine by half a cycle
        **dict.fromkeys(("foot_height", "foot_air_time", "foot_contact"), feet), "foot_force": vectors,
        # qpos and qvel also contain joints that the task does not use
        "qpos": ([*range(7), *(partner[hinges] + 6)], [*flip, 1.0, *spin, *sign[hinges]]),
        "qvel": ([*range(6), *(partner[hinges] + 5)], [*flip, *spin, *sign[hinges]]),
    }  # fmt: skip
    if hasattr(p, "scan"):
        scan = np.asarray(p.scan)
        rows = np.linalg.norm(scan[None] - scan[:, None] * flip[:2], axis=2).argmin(1)
        maps["height_scan"] = rows, np.ones(len(rows))
    return Mirror(maps)


def mirror_order(places: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Find the index of each place's mirror image in the plane y = 0 among places (n, 3).

    Raises:
        ValueError: A place has no mirror image.
    """
    distances = np.linalg.norm(places[None] - (places * [1.0, -1.0, 1.0])[:, None], axis=2)
    if distances.min(1).max() > 0.005:
        alone = names[distances.min(1).argmax()]
        raise ValueError(f"{alone} has no mirror image among the others: place or name one on each side of the robot")
    return distances.argmin(1)


def mirror_rows(order: np.ndarray, signs: Sequence[float] | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Make the map of a table with the row ``order[i]`` in place of row i, and with a sign for each column."""
    return (len(signs) * order[:, None] + np.arange(len(signs))).ravel(), np.tile(signs, len(order))


# legs


def leg_joints(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """List the joints from the base to each foot, (feet, joints of the longest leg). Rows of shorter legs end with -1.

    Raises:
        ValueError: A foot is not connected to the base by hinges.
    """
    chains = [leg_of(model, int(model.site_bodyid[foot])) for foot in p.feet]
    longest = max(map(len, chains))
    return np.array([chain + (longest - len(chain)) * [-1] for chain in chains])


def leg_qpos(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the indices of ``leg_joints`` in ``qpos``. Rows of shorter legs end with -1."""
    joints = leg_joints(model, p)
    return np.where(joints < 0, -1, model.jnt_qposadr[joints])


def leg_dof(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the indices of ``leg_joints`` in ``qvel``. Rows of shorter legs end with -1."""
    joints = leg_joints(model, p)
    return np.where(joints < 0, -1, model.jnt_dofadr[joints])


def leg_axes(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the axes of ``leg_joints``, (feet, joints of the longest leg, 3)."""
    data = straight(model)
    return data.xaxis[leg_joints(model, p)]


def leg_offsets(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get the positions of ``leg_joints`` relative to the previous joint of the leg, or to the base, in m."""
    anchors = straight(model).xanchor[leg_joints(model, p)]
    return np.diff(anchors, axis=1, prepend=0.0)


def foot_offsets(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Get each foot's position relative to its last joint, (feet, 3) in m."""
    data = straight(model)
    return np.array([data.site_xpos[foot] - data.xanchor[_last_joint(model, foot)] for foot in p.feet])


def soles(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Compute spheres that touch a plane if and only if the foot does.

    The result, (feet, spheres, 4), has each sphere's centre relative to the foot's last joint, and its radius, in m.
    Spheres lie at the ends of a capsule and at the corners of a box. For any other geom, they lie at the corners of its
    bounding box. Radii include the margin at which a contact starts to exert force.

    Raises:
        ValueError: A foot has no geom in ``foot_geoms``.
    """
    data = straight(model)
    spheres = []
    for foot in p.feet:
        geoms = [geom for geom in p.foot_geoms if model.geom_bodyid[geom] == model.site_bodyid[foot]]
        if not geoms:
            raise ValueError(f"no geom in foot_geoms belongs to the body of the foot {model.site(foot).name!r}")
        sole = np.concatenate([_with_margin(model, geom, spheres_of(model, data, geom)) for geom in geoms])
        sole[:, :3] -= data.xanchor[_last_joint(model, foot)]
        spheres.append(sole)
    most = max(map(len, spheres))
    return np.array([np.resize(sole, (most, 4)) for sole in spheres])  # pad with copies


def foot_geoms(model: mujoco.MjModel, p: Any) -> list[int]:
    """List the feet's geoms that can touch the ground. The ground consists of all geoms of the world body.

    Raises:
        ValueError: A foot has no geom that can touch the ground.
    """
    feet_geoms = []
    for foot in p.feet:
        touching = contact_geoms(model, int(model.site_bodyid[foot]))
        if not touching:
            raise ValueError(f"the foot {model.site(foot).name!r} has no geom that can touch the ground")
        feet_geoms += touching
    return feet_geoms


def contact_geoms(model: mujoco.MjModel, body: int) -> list[int]:
    """List a body's geoms that can touch a geom of the world body."""
    ground, geoms = np.flatnonzero(model.geom_bodyid == 0), np.flatnonzero(model.geom_bodyid == body)
    types, affinities = model.geom_contype, model.geom_conaffinity
    touches = types[geoms, None] & affinities[ground] | types[ground] & affinities[geoms, None]
    pairs = {frozenset(pair) for pair in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)}
    listed = [[frozenset((geom, other)) in pairs for other in ground.tolist()] for geom in geoms.tolist()]
    return geoms[(touches.astype(bool) | np.reshape(listed, touches.shape).astype(bool)).any(axis=1)].tolist()


def foot_forces(model: mujoco.MjModel, p: Any) -> list[int]:
    """Get the index in ``sensordata`` of each foot's force sensor, FOOT_force, (feet,).

    Raises:
        ValueError: The model has no sensor FOOT_force with three numbers.
    """
    addresses = []
    for foot in p.feet:
        name = f"{model.site(foot).name}_force"
        sensor = mujoco.mj_name2id(model, _SENSOR, name)
        if sensor < 0 or model.sensor_dim[sensor] != 3:
            raise ValueError(f"the model has no sensor {name!r} of a contact's force: prepare_walker adds this sensor")
        addresses.append(int(model.sensor_adr[sensor]))
    return addresses


def leg_of(model: mujoco.MjModel, body: int) -> list[int]:
    """List the joints from the base to a body.

    Raises:
        ValueError: The body is not connected to the base by hinges.
    """
    joints: list[int] = []
    trunk, name = base(model), _name(model, mujoco.mjtObj.mjOBJ_BODY, body)
    while body not in (0, trunk):
        first = int(model.body_jntadr[body])
        joints = [*range(first, first + int(model.body_jntnum[body])), *joints]
        body = int(model.body_parentid[body])
    if body == 0 or not joints:
        raise ValueError(f"no joint connects the body {name} of a foot to the base {model.body(trunk).name!r}")
    for joint in joints:
        if model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            raise ValueError(f"the joint {_name(model, _JOINT, joint)} of a leg is not a hinge")
    return joints


def _last_joint(model: mujoco.MjModel, foot: int) -> int:
    return leg_of(model, int(model.site_bodyid[foot]))[-1]


def straight(model: mujoco.MjModel) -> mujoco.MjData:
    """Compute the kinematics with the base at the origin and all hinges at 0."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE]] = 0.0
    start = int(model.jnt_qposadr[0])
    data.qpos[start : start + 7] = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    mujoco.mj_kinematics(model, data)
    return data


def _with_margin(model: mujoco.MjModel, geom: int, spheres: np.ndarray) -> np.ndarray:
    """Increase the spheres' radii by the distance at which a contact with the ground starts to exert force."""
    ground = np.flatnonzero(model.geom_bodyid == 0)
    margin = model.geom_margin[geom] + model.geom_margin[ground].max()
    gap = model.geom_gap[geom] + model.geom_gap[ground].max()
    return spheres + np.array([0.0, 0.0, 0.0, margin - gap])


def spheres_of(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> np.ndarray:
    """Compute the spheres of a geom for ``soles``, in the world's axes, (spheres, 4)."""
    size, kind = model.geom_size[geom], mujoco.mjtGeom
    radius, middle = 0.0, np.zeros(3)
    if model.geom_type[geom] == kind.mjGEOM_SPHERE:
        radius, points = float(size[0]), np.zeros((1, 3))
    elif model.geom_type[geom] == kind.mjGEOM_CAPSULE:
        radius, points = float(size[0]), np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]])
    elif model.geom_type[geom] == kind.mjGEOM_BOX:
        points = _CORNERS * size
    else:
        middle, points = model.geom_aabb[geom, :3], _CORNERS * model.geom_aabb[geom, 3:]
    centres = data.geom_xpos[geom] + (middle + points) @ data.geom_xmat[geom].reshape(3, 3).T
    return np.hstack([centres, np.full((len(points), 1), radius)])


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return repr(mujoco.mj_id2name(model, kind, int(index)) or int(index))


# models


def prepare_walker(
    spec: mujoco.MjSpec,
    feet: Sequence[str],
    *,
    timestep: float | None = None,
    iterations: tuple[int, int] | None = None,
) -> None:
    """Prepare a model for a velocity task: add force sensors to the feet, and ignore the friction of the ground.

    The model's own sensors are removed, because they cost time and the task does not read them. Geoms of the feet get
    priority in contacts, so their randomized friction applies. Explicit contact pairs between a foot and the ground are
    deleted. Ordinary contacts then take their place.

    Args:
        spec: The model, which is changed in place.
        feet: Names of the sites of the feet.
        timestep: Seconds in a substep, or None for the model's time step.
        iterations: Maximum iterations of the solver and of the line search, or None for the model's limits.

    Raises:
        ValueError: A foot's site is missing.
    """
    if timestep is not None:
        spec.option.timestep = timestep
    if iterations is not None:
        spec.option.iterations, spec.option.ls_iterations = iterations
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    ground = {geom.name: geom for geom in spec.worldbody.geoms}
    for pair in list(spec.pairs):
        if (names := {pair.geomname1, pair.geomname2}) & ground.keys():
            (foot,) = names - ground.keys()
            spec.geom(foot).conaffinity, spec.geom(foot).condim = 1, pair.condim
            spec.delete(pair)
    for geom in ground.values():
        geom.priority = 0
    for name in feet:
        site = spec.site(name)
        if site is None:
            raise ValueError(f"the model has no site {name!r} for a foot")
        site.parent.name = site.parent.name or f"{name}_body"
        for geom in site.parent.geoms:
            if geom.contype or geom.conaffinity:
                geom.priority, geom.condim = 1, max(3, geom.condim)
        spec.add_sensor(
            name=f"{name}_force", type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=site.parent.name, intprm=[_FORCE, _NET, 1],
        )  # fmt: skip


def add_self_contact(spec: mujoco.MjSpec, name: str) -> None:
    """Add a sensor of the largest contact force between parts of the robot, three numbers in the contact's axes (N).

    Args:
        spec: The model, which is changed in place. Its first joint is the free joint of the robot's base.
        name: The name of the sensor.
    """
    body = spec.joints[0].parent
    body.name = body.name or "base"
    tree = mujoco.mjtObj.mjOBJ_XBODY
    spec.add_sensor(
        name=name, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=tree, objname=body.name, reftype=tree,
        refname=body.name, intprm=[_FORCE, _LARGEST, 1],
    )  # fmt: skip


def add_feet(spec: mujoco.MjSpec, feet: Mapping[str, tuple[str, Sequence[float]]]) -> None:
    """Add one site per foot to a model.

    Args:
        spec: The model, which is changed in place.
        feet: For each new site, a body's name and the site's position in the body, in m. A joint's or geom's name
            stands for its body.

    Raises:
        ValueError: The model has no element of this name.
    """
    for name, (element, position) in feet.items():
        owner = spec.joint(element) or spec.geom(element)
        body = spec.body(element) or (owner and owner.parent)
        if body is None:
            raise ValueError(f"the model has no body, joint or geom {element!r} for the foot {name!r}")
        body.add_site(name=name, pos=position)


def use_servos(spec: mujoco.MjSpec, joints: Sequence[str], *, reach: float = 1.0) -> None:
    """Turn the motors of joints into position servos. Existing servos do not change.

    A servo reaches its motor's force limit at a position error of ``reach`` rad, so kp = limit / reach. It is
    critically damped at ``qpos0``: M s^2 + kd s + kp has a double root for the joint's inertia M.

    Args:
        spec: The model, which is changed in place.
        joints: Names of joints with one actuator each.
        reach: Position error at which a servo's force reaches its limit, in rad.

    Raises:
        ValueError: A joint has no actuator, or its force has no limit.
    """
    model = spec.copy().compile()
    p = SimpleNamespace(joints=[model.joint(name).id for name in joints])
    for name, joint, actuator in zip(joints, p.joints, servos(model, p), strict=True):
        if model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_NONE:
            continue
        gear, gain = abs(float(model.actuator_gear[actuator, 0])), float(model.actuator_gainprm[actuator, 0])
        limits = [math.inf]
        if model.actuator_forcelimited[actuator]:
            limits.append(gear * float(model.actuator_forcerange[actuator, 1]))
        if model.actuator_ctrllimited[actuator]:
            limits.append(gear * abs(gain * float(model.actuator_ctrlrange[actuator, 1])))
        if model.jnt_actfrclimited[joint]:
            limits.append(float(model.jnt_actfrcrange[joint, 1]))
        if not math.isfinite(limit := min(limits)):
            raise ValueError(f"the motor of the joint {name!r} has no limit: give it a ctrlrange or a forcerange")
        kp, dof = limit / reach, int(model.jnt_dofadr[joint])
        kd = max(2.0 * math.sqrt(kp * model.dof_M0[dof]) - model.dof_damping[dof].sum(), 0.0)
        servo = spec.actuators[actuator]
        servo.set_to_position(kp=kp, kv=kd)
        servo.gear = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        servo.forcelimited, servo.forcerange = True, (-limit, limit)
        servo.ctrllimited, servo.inheritrange = False, 0.0


def round_feet(spec: mujoco.MjSpec, feet: Sequence[str], *, radius: float = 0.015) -> None:
    """Replace each colliding box of a foot by two capsules along its longer side, for use on height fields.

    MuJoCo Warp 4.0 finds wrong contacts between boxes and height fields. These contacts throw robots into the air. The
    capsules lie within the outline of the sole and touch its lowest plane. Masses do not change.

    Args:
        spec: The model after ``prepare_walker``, which is changed in place.
        feet: Names of the sites of the feet.
        radius: Radius of the capsules, in m.

    Raises:
        ValueError: A box is narrower than a capsule.
    """
    box_type = mujoco.mjtGeom.mjGEOM_BOX
    for name in feet:
        for box in [g for g in spec.site(name).parent.geoms if g.type == box_type and (g.contype or g.conaffinity)]:
            long, short = (0, 1) if box.size[0] >= box.size[1] else (1, 0)
            if box.size[short] < radius:
                raise ValueError(f"the box of the foot {name!r} is {2 * box.size[short]} m wide: use a smaller radius")
            frame = spec.site(name).parent.add_frame(pos=box.pos, quat=box.quat)
            for kind in ("type", "axisangle", "xyaxes", "zaxis", "euler"):
                setattr(frame.alt, kind, getattr(box.alt, kind))
            for side in (-1.0, 1.0):
                position = np.zeros(3)
                position[short], position[2] = side * (box.size[short] - radius), radius - box.size[2]
                capsule = spec.site(name).parent.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[radius, box.size[long] - radius, 0.0], mass=0.0,
                    pos=position, quat=[1.0, 0.0, 1.0, 0.0] if long == 0 else [1.0, 1.0, 0.0, 0.0], group=box.group,
                    contype=box.contype, conaffinity=box.conaffinity, condim=box.condim, priority=box.priority,
                    friction=box.friction, solref=box.solref, solimp=box.solimp, margin=box.margin, gap=box.gap,
                )  # fmt: skip
                capsule.set_frame(frame)
            box.contype = box.conaffinity = 0
