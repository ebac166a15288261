"""PandaLift: grasp a cube on a table and lift it (a Franka Panda with its gripper, as in robosuite's Lift).

The arm's model, which the extra "robots" installs, has no gripper. The hand, the table and the cube are in MJCF files
of the package. Actions are the velocities at which the targets of the position servos move. The arm compensates for
gravity, as the real robot does. Collisions use capsules fitted to the arm, and meshes are visual only. Success: the
cube has been above the goal height for ten consecutive steps.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

HOME = (0.0, 0.1, 0.0, -2.1, 0.0, 2.2, 0.785, 0.03, 0.03)  # gripper points down


@wp.struct
class World:
    qpos: Row[float]  # 7 joints of the arm, 2 fingers, position and quaternion of the cube
    qvel: Row[float]
    act: Row[float]  # the servo targets of arm and gripper
    xpos: Row[wp.vec3]
    xmat: Row[wp.mat33]
    site_xpos: Row[wp.vec3]
    site_xmat: Row[wp.mat33]


@wp.struct
class Params:
    goal_height: float = 0.1
    half_size: float = 0.02  # of the cube, m
    area: wp.vec4 = wp.vec4(0.45, 0.65, -0.15, 0.15)  # initial x min, x max, y min, y max of the cube, m
    cube: int = lw.body("table/cube")
    cube_qpos: int = lw.qpos("table/cube")
    finger: int = lw.qpos("hand/left_finger")
    grip: int = lw.site("hand/grip")  # between the finger pads


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 0, 9)
    k = lw.put(obs, k, s.qvel)
    k = lw.put(obs, k, s.act)
    k = lw.put(obs, k, s.xpos[p.cube])
    k = lw.put(obs, k, s.xmat[p.cube])
    k = lw.put(obs, k, s.xpos[p.cube] - s.site_xpos[p.grip])


@wp.func
def evaluate(s: World, p: Params) -> float:  # the height of the cube above the table
    return s.xpos[p.cube][2] - p.half_size


@wp.func
def terms(s: World, p: Params) -> wp.vec4:
    grip = s.site_xmat[p.grip]  # z points out of the hand, and the fingers slide along y
    distance = wp.length(s.xpos[p.cube] - s.site_xpos[p.grip])
    near, reach, grasp = lw.grasp_terms(distance, s.qpos[p.finger], p.half_size)
    # the grip is best if the gripper points down, and the fingers slide along an edge of the cube
    orient = wp.clamp(-grip[2, 2], 0.0, 1.0) * wp.max(wp.abs(wp.transpose(s.xmat[p.cube]) * grip[:, 1]))
    lift = near * orient * wp.clamp(evaluate(s, p) / (1.5 * p.goal_height), 0.0, 1.0)
    return wp.vec4(reach, orient, grasp, lift)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.dot(terms(s1, p), wp.vec4(1.0, 0.5, 1.0, 4.0)) - 0.01 * lw.sum_squares(action)


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s1, p))


@wp.func
def success(s: World, p: Params) -> bool:
    return evaluate(s, p) > p.goal_height


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    x, y = lw.uniform(rng, p.area[0], p.area[1]), lw.uniform(rng, p.area[2], p.area[3])
    place = wp.vec3(x, y, p.half_size - 1e-4)  # the resting cube's weight presses it slightly into the table
    lw.put_upright(s.qpos, p.cube_qpos, place, lw.uniform(rng, -wp.pi, wp.pi))


@lw.register
class PandaLift(lw.Task):
    model = lw.package_model("robopal", "assets/models/manipulators/Panda/panda.xml", install="lyceum-warp[robots]")
    keyframe = "start"
    frame_skip, horizon, success_steps = 8, 150, 10
    obs = {"position": 9, "velocity": 15, "target": 8, "cube": 3, "cube_axes": 9, "cube_from_grip": 3}
    metrics = ("reach", "orient", "grasp", "lift")
    action_range = (-1.0, 1.0)
    # planning with half the substeps is 1.8 times as fast; with longer substeps, contacts are softer and grasps fail
    physics = {"fast": lw.PhysicsOptions(frame_skip=4, timestep=0.01)}
    planning = lw.Planning(settings=dict(horizon=16, samples=64, temperature=0.5, noise=0.6, include_plan=False))

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        spec.option.timestep, spec.option.cone = 0.005, mujoco.mjtCone.mjCONE_ELLIPTIC
        for i, (motor, joint) in enumerate(zip(spec.actuators, spec.joints, strict=True)):
            kp, force = (4500.0, 87.0) if i < 4 else (2000.0, 12.0)  # the robot's published torque limits, N m
            motor.set_to_position(kp=kp, kv=0.05 * kp)
            motor.ctrlrange, motor.forcerange = joint.range, (-force, force)
            lw.follow_velocity(motor, 1.0)  # rad/s
        for geom in spec.geoms:
            if geom.classname.name == "panda/collision":
                geom.type, geom.contype, geom.parent.gravcomp = mujoco.mjtGeom.mjGEOM_CAPSULE, 0, 1.0
        for name, prefix, parent in (("hand", "hand/", "attachment"), ("lift", "table/", "world")):
            child = lw.package_model("lyceum_warp", f"tasks/panda_{name}.xml").spec()
            spec.attach(child, prefix=prefix, frame=spec.body(parent).add_frame())
        spec.add_key(name="start", qpos=[*HOME, 0.55, 0.0, 0.0199, 1.0, 0.0, 0.0, 0.0], act=HOME[:8])
