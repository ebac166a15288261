"""PointMass: push a point onto a target in the plane (Lyceum's PointMass)."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # agent x, y, target x, y
    qvel: Row[float]


@wp.struct
class Params:
    dt: float
    success_distance: float = 0.05


@wp.func
def distance(s: World) -> float:
    return wp.length(wp.vec2(s.qpos[0] - s.qpos[2], s.qpos[1] - s.qpos[3]))


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    for i in range(2):
        obs[i] = s.qpos[i]
        obs[i + 2] = s.qvel[i]
        obs[i + 4] = s.qpos[i + 2]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return 1.0 - distance(s1)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return distance(s)


@wp.func
def success(s: World, p: Params) -> bool:
    return distance(s) < p.success_distance


@wp.func
def initialize(s: World, p: Params):
    s.qpos[2] = 1.0


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(4):
        s.qpos[i] = lw.uniform(rng, -1.0, 1.0)


def point_mass() -> mujoco.MjSpec:
    """A ball of 0.3 kg with two motors, and a target that slides freely so that it is part of the state."""
    spec = mujoco.MjSpec()
    spec.modelname = "point_mass"
    spec.option.timestep = 0.02
    spec.option.gravity = (0, 0, 0)
    spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.5, 0.6, 0.8), rgb2=(0.9, 0.9, 0.9), width=64, height=384,
    )  # fmt: skip
    spec.worldbody.add_light(pos=(0, 0, 3))
    spec.worldbody.add_camera(name="above", pos=(0, 0, 4))
    for name, colour in (("agent", (0.2, 0.4, 0.8, 1)), ("target", (0.2, 0.7, 0.3, 1))):
        body = spec.worldbody.add_body(name=name)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.05, 0, 0), mass=0.3, contype=0, conaffinity=0,
                      rgba=colour)  # fmt: skip
        for axis, direction in (("x", (1, 0, 0)), ("y", (0, 1, 0))):
            joint = body.add_joint(name=f"{name}_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=direction)
            joint.limited, joint.range = True, (-1.4, 1.4)
            joint.damping[0], joint.armature = 0.1, 0.01
    for axis in "xy":
        motor = spec.add_actuator(name=axis, target=f"agent_{axis}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gear[0] = 4
        motor.ctrllimited, motor.ctrlrange = True, (-1, 1)
    return spec


@lw.register
class PointMass(lw.Task):
    model = staticmethod(point_mass)
    obs = {"position": 2, "velocity": 2, "target": 2}
    horizon = 256
