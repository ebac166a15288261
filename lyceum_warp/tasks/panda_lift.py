"""PandaLift: grasp a cube on a table and lift it (a Franka Panda with its gripper, as in robosuite's Lift).

The arm comes with the extra "robots" and has no gripper there; hand, table and cube are MJCF files beside this one.
Actions are velocities: each moves the target of a position actuator, so that a joint which gets no velocity stands
still. As in the robot itself, gravity is compensated. The arm's meshes are drawn; capsules around them collide with
table and cube. The reward is a sum of terms between 0 and 1: for reaching the cube, for the gripper's orientation, for
closing around the cube, and for lifting it. An episode is a success while the cube was held up for ten steps.
"""

from pathlib import Path

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

HOME = (0.0, 0.1, 0.0, -2.1, 0.0, 2.2, 0.785, 0.03, 0.03)
"""Joints of arm and fingers at the start: the gripper points down, 27 cm above the table."""


@wp.struct
class World:
    qpos: Row[float]  # 7 joints of the arm, 2 fingers, the cube's position and quaternion
    qvel: Row[float]
    act: Row[float]  # targets of arm and gripper
    xpos: Row[wp.vec3]
    xmat: Row[wp.mat33]
    site_xpos: Row[wp.vec3]
    site_xmat: Row[wp.mat33]
    memory: Row[float]  # steps in which the cube was held up


@wp.struct
class Params:
    dt: float
    cube: int = lw.body("table/cube")
    cube_qpos: int = lw.qpos("table/cube")
    finger: int = lw.qpos("hand/left_finger")
    grip: int = lw.site("hand/grip")  # between the pads of the fingers
    half_size: float = 0.02  # of the cube, in m
    goal_height: float = 0.1
    goal_steps: float = 10.0
    area: wp.vec4 = wp.vec4(0.45, 0.65, -0.15, 0.15)  # of the cube at the start: x from, to, y from, to


@wp.func
def height(s: World, p: Params) -> float:
    return s.xpos[p.cube][2] - p.half_size


@wp.func
def terms(s: World, p: Params) -> wp.vec4:
    distance = wp.length(s.xpos[p.cube] - s.site_xpos[p.grip])
    grip, cube = s.site_xmat[p.grip], s.xmat[p.cube]
    # the fingers move along the y axis of the gripper, which lies along one of the cube's edges
    y = wp.vec3(grip[0, 1], grip[1, 1], grip[2, 1])
    along = wp.max(wp.abs(wp.transpose(cube) * y))
    around = lw.tolerance(distance, wp.vec2(0.0, 0.01), 0.01)
    opening = 0.5 * (s.qpos[p.finger] + s.qpos[p.finger + 1])
    closed = lw.tolerance(opening, wp.vec2(0.0, p.half_size), 0.02, int(lw.Sigmoid.LINEAR))
    orient = wp.clamp(-grip[2, 2], 0.0, 1.0) * along
    return wp.vec4(
        lw.tolerance(distance, wp.vec2(0.0, 0.005), 0.1, int(lw.Sigmoid.RECIPROCAL), 0.2),
        orient,
        around * closed + 0.5 * (1.0 - around) * (1.0 - closed),
        around * orient * wp.clamp(height(s, p) / (1.5 * p.goal_height), 0.0, 1.0),
    )


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 0, 9)
    k = lw.put(obs, k, s.qvel)
    k = lw.put(obs, k, s.act)
    k = lw.put(obs, k, s.xpos[p.cube])
    k = lw.put(obs, k, s.xmat[p.cube])
    k = lw.put(obs, k, s.xpos[p.cube] - s.site_xpos[p.grip])


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    t = terms(s1, p)
    return t[0] + 0.5 * t[1] + t[2] + 4.0 * t[3] - 0.01 * lw.sum_squares(action)


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return height(s, p)


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    held = height(s1, p) > p.goal_height
    s1.memory[0] = wp.where(held, s0.memory[0] + 1.0, 0.0)


@wp.func
def success(s: World, p: Params) -> bool:
    return s.memory[0] >= p.goal_steps


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[p.cube_qpos] = lw.uniform(rng, p.area[0], p.area[1])
    s.qpos[p.cube_qpos + 1] = lw.uniform(rng, p.area[2], p.area[3])
    half = 0.5 * lw.uniform(rng, -wp.pi, wp.pi)
    s.qpos[p.cube_qpos + 3] = wp.cos(half)
    s.qpos[p.cube_qpos + 6] = wp.sin(half)


@lw.register
class PandaLift(lw.Task):
    model = lw.package_model(
        "robopal", "assets/models/manipulators/Panda/panda.xml", install="lyceum-warp[robots]"
    )
    keyframe = "home"
    frame_skip = 8
    obs = {"position": 9, "velocity": 15, "target": 8, "cube": 3, "cube_axes": 9, "cube_from_grip": 3}
    metrics = ("reach", "orient", "grasp", "lift")
    horizon = 150
    memory = 1
    action_range = (-1.0, 1.0)
    planning = lw.Planning(settings={"horizon": 16, "samples": 64, "temperature": 0.5, "noise": 0.6})

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Put the arm at a table, give it a hand, and turn its motors into velocity-controlled servos."""
        spec.option.timestep = 0.005
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.body("link0").gravcomp = 1
        for i, actuator in enumerate(spec.actuators):
            strong = i < 4  # gains as in MuJoCo Menagerie, with half the damping; the published limits
            actuator.set_to_intvelocity(kp=4500 if strong else 2000, kv=225 if strong else 100)
            actuator.actrange = spec.joint(f"joint{i + 1}").range
            actuator.ctrlrange = (-1.0, 1.0)  # rad/s
            actuator.forcerange = (-87, 87) if strong else (-12, 12)
        for geom in spec.geoms:
            if geom.classname.name == "panda/collision":
                geom.type, geom.contype = mujoco.mjtGeom.mjGEOM_CAPSULE, 0
        for file, prefix, parent in (("panda_hand.xml", "hand/", "attachment"), ("panda_lift.xml", "table/", "world")):
            child = mujoco.MjSpec.from_file(str(Path(__file__).with_name(file)))
            spec.attach(child, frame=spec.body(parent).add_frame(), prefix=prefix)
        for body in spec.body("link0").find_all("body"):
            body.gravcomp = 1
        for key in spec.keys:
            spec.delete(key)
        spec.add_key(name="home", qpos=[*HOME, 0.55, 0, 0.02, 1, 0, 0, 0], act=HOME[:8])
