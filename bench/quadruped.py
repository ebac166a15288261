"""Quadruped: dm_control's walking quadruped, observed through gyro, velocimeter and frame sensors.

The model is that of dm_control's walk task, read from its files, with frame sensors added; its sensors of forces and
accelerations stay, unread. Reward and first states are dm_control's, except for the height, from which every
orientation is clear of the floor.
"""

import importlib.util
from pathlib import Path

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

TOES = tuple(f"toe_{end}_{side}" for end in ("front", "back") for side in ("left", "right"))


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    act: Row[float]
    sensordata: Row[float]


@wp.struct
class Params:
    dt: float
    speed: float = 0.5  # metres a second, from which on the reward is full
    height: float = 1.1
    gyro: int = lw.sensor("imu_gyro")
    velocimeter: int = lw.sensor("velocimeter")
    frames: int = lw.sensor("torso_up")  # the first of the frame sensors, in their order


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    for i in range(16):
        obs[i] = s.qpos[7 + i]
        obs[16 + i] = s.qvel[6 + i]
    for i in range(12):
        obs[32 + i] = s.act[i]
    for i in range(3):
        obs[44 + i] = s.sensordata[p.velocimeter + i]
        obs[47 + i] = s.sensordata[p.gyro + i]
    for i in range(18):
        obs[50 + i] = s.sensordata[p.frames + i]


@wp.func
def upright(s: World, p: Params) -> float:
    return (1.0 + s.sensordata[p.frames + 2]) / 2.0


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    missing = wp.max(0.0, p.speed - s1.sensordata[p.velocimeter]) / p.speed
    return upright(s1, p) * wp.max(0.0, 1.0 - 0.5 * missing)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.sensordata[p.velocimeter]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    q = wp.vec4(lw.normal(rng), lw.normal(rng), lw.normal(rng), lw.normal(rng))
    q = q / wp.max(wp.length(q), 1.0e-6)
    s.qpos[2] = p.height
    for i in range(4):
        s.qpos[3 + i] = q[i]


def quadruped() -> mujoco.MjSpec:
    """dm_control's model without walls, ball, target, terrain and range finders, as in its walk task."""
    package = importlib.util.find_spec("dm_control")
    if package is None or not package.submodule_search_locations:
        raise ValueError("the quadruped is dm_control's, which is not installed: pip install dm_control")
    spec = mujoco.MjSpec.from_file(str(Path(package.submodule_search_locations[0], "suite", "quadruped.xml")))
    spec.delete(spec.body("ball"))
    spec.delete(spec.site("target"))
    for name in ("wall_px", "wall_py", "wall_nx", "wall_ny", "terrain"):
        spec.delete(spec.geom(name))
    for hfield in list(spec.hfields):
        spec.delete(hfield)
    for sensor in list(spec.sensors):
        if sensor.type == mujoco.mjtSensor.mjSENS_RANGEFINDER:
            spec.delete(sensor)
    spec.geom("floor").size = (10, 10, 0.5)
    kind, body = mujoco.mjtSensor, mujoco.mjtObj.mjOBJ_XBODY
    spec.add_sensor(name="torso_up", type=kind.mjSENS_FRAMEZAXIS, objtype=body, objname="torso")
    spec.add_sensor(name="torso_linvel", type=kind.mjSENS_FRAMELINVEL, objtype=body, objname="torso")
    for toe in TOES:
        spec.add_sensor(
            name=f"position_{toe}", type=kind.mjSENS_FRAMEPOS, objtype=body, objname=toe, reftype=body, refname="torso"
        )
    return spec


class Quadruped(lw.Task):
    model = staticmethod(quadruped)
    frame_skip = 4
    obs = {"hinges": 16, "hinge_velocities": 16, "activations": 12, "velocity": 3, "gyro": 3, "frames": 18}
    horizon = 1000
