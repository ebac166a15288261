"""QuadrupedWalk: a quadruped gets up and walks at 0.5 m/s."""

from typing import Any

import mujoco
import numpy as np
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms
from lyceum_warp.tasks.dm import suite

RESOLUTION = wp.constant(0.01)  # m


def solid(model: mujoco.MjModel, p: Any) -> np.ndarray:
    return np.flatnonzero(model.geom_bodyid > 0)


def centers(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Return the centres of the geoms in the torso's axes, (geoms, 3) in m."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.geom_xpos[p.geoms] - data.xpos[p.torso]


def axes(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Return the rotation matrix of each geom relative to the torso, (geoms, 3, 3)."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.geom_xmat[p.geoms].reshape(-1, 3, 3)


def radii(model: mujoco.MjModel, p: Any) -> np.ndarray:
    """Return three radii and the half length of each geom, (geoms, 4) in m.

    The radii are along the geom's axes. The half length is 0 unless the geom is a capsule or a cylinder.
    """
    kind = mujoco.mjtGeom
    table = np.zeros((len(p.geoms), 4))
    for row, geom in zip(table, p.geoms, strict=True):
        size, shape = model.geom_size[geom], model.geom_type[geom]
        long = shape in (kind.mjGEOM_CAPSULE, kind.mjGEOM_CYLINDER)
        row[:3] = size if shape == kind.mjGEOM_ELLIPSOID else size[0]
        row[2] *= shape != kind.mjGEOM_CYLINDER
        row[3] = size[1] * long
    return table


@wp.struct
class World:
    qpos: Row[float]  # a free joint and 16 hinges
    qvel: Row[float]
    act: Row[float]
    xmat: Row[wp.mat33]
    sensordata: Row[float]


@wp.struct
class Params:
    speed: float = 0.5  # m/s
    torso: int = lw.body("torso")
    imu: int = lw.sensor("imu_accel")  # and the gyroscope
    forces: int = lw.sensor("force_toe_front_left")  # 4 forces, then 4 torques
    geoms: wp.array[int] = lw.from_model(solid)  # geoms of the robot
    geom_center: wp.array[wp.vec3] = lw.from_model(centers)  # centres relative to the torso, m
    geom_axes: wp.array[wp.mat33] = lw.from_model(axes)  # rotation matrices relative to the torso
    geom_radii: wp.array[wp.vec4] = lw.from_model(radii)  # three radii and the half length of each geom, m


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 7, s.qpos.shape[0])
    k = lw.put(obs, k, s.qvel, 6, s.qvel.shape[0])
    k = lw.put(obs, k, s.act)
    k = lw.put(obs, k, terms.linear_velocity(s.qpos, s.qvel))
    k = lw.put(obs, k, s.xmat[p.torso][2, 2])
    k = lw.put(obs, k, s.sensordata, p.imu, p.imu + 6)
    for i in range(p.forces, p.forces + 24):
        size = wp.abs(s.sensordata[i])
        k = lw.put(obs, k, wp.sign(s.sensordata[i]) * wp.log(size + wp.sqrt(size * size + 1.0)))  # arcsinh


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    upright = lw.tolerance(s1.xmat[p.torso][2, 2], wp.vec2(1.0, wp.inf), 2.0, lw.Sigmoid.LINEAR, 0.0)
    forward, fast = terms.linear_velocity(s1.qpos, s1.qvel)[0], wp.vec2(p.speed, wp.inf)
    return upright * lw.tolerance(forward, fast, p.speed, lw.Sigmoid.LINEAR, 0.5)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    """Start in a random orientation, just above the floor: at the lowest of the tried heights without contact."""
    quat = lw.quat_random(rng)
    lw.put(s.qpos, 3, quat)
    down = lw.quat_rotate_inverse(quat, wp.vec3(0.0, 0.0, -1.0))
    depth = float(0.0)  # the lowest point's distance below the torso
    for i in range(p.geoms.shape[0]):
        d, r = down * p.geom_axes[i], p.geom_radii[i]
        reach = wp.length(wp.vec3(r[0] * d[0], r[1] * d[1], r[2] * d[2])) + r[3] * wp.abs(d[2])
        depth = wp.max(depth, wp.dot(down, p.geom_center[i]) + reach)
    lw.put(s.qpos, 0, wp.vec3(0.0, 0.0, RESOLUTION * wp.ceil(depth / RESOLUTION)))


@lw.register
class QuadrupedWalk(lw.Task):
    model, frame_skip = suite.model("quadruped"), 4
    obs = {"egocentric_state": 44, "torso_velocity": 3, "torso_upright": 1, "imu": 6, "force_torque": 24}
    floor = 10.0  # half its length, m

    @classmethod
    def edit_model(cls, spec: mujoco.MjSpec) -> None:
        """Remove elements of dm_control's other tasks, and set the size of the floor."""
        unused = (spec.site("target"), spec.body("ball"), spec.geom("terrain"), spec.hfield("terrain"))
        for element in (*unused, *(spec.geom(f"wall_{side}") for side in ("px", "py", "nx", "ny"))):
            spec.delete(element)
        for sensor in list(spec.sensors):
            if sensor.type == mujoco.mjtSensor.mjSENS_RANGEFINDER:
                spec.delete(sensor)
        spec.geom("floor").size[:2] = cls.floor


@lw.register
class QuadrupedRun(QuadrupedWalk):
    """A quadruped gets up and runs at 5 m/s."""

    params = {"speed": 5.0}
    floor = 100.0
