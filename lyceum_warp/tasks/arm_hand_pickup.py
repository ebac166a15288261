"""ArmHandPickup: an arm with a hand picks up a ball and holds it at a goal (Lyceum's ArmHandPickup).

The arm and its hand of three fingers are Kinova's Jaco, from the extra "jaco"; Lyceum joins a Jaco arm with the hand of
five fingers of the Modular Prosthetic Limb. Goal, distances, reward and the ball's start are Lyceum's, with its error
corrected: Lyceum's second stage measures the ball against ball - goal, a distance that is the same everywhere, so that
its reward knows nothing of the goal. Here it is the distance of the ball from the goal. Joints are driven at speeds,
within the arm's published limits, and are observed; a step takes 20 ms, Lyceum's 6. Arm and hand touch the table and
the ball, not themselves. An episode is a success once the ball has stayed within 5 cm of the goal for 0.2 s.
"""

from pathlib import Path

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

HAND = lw.package_model("dm_control", "third_party/kinova/jaco_hand.xml", install="lyceum-warp[jaco]")
HOME = (1.775, 3.682, 1.303, 3.395, 5.351, 3.133, 0.2, 0.2, 0.2)
"""Joints at the start, in radians: the hand points down, open, 20 cm above the middle of the table."""


@wp.struct
class World:
    qpos: Row[float]  # 6 joints of the arm, 3 of the fingers, the ball's position and quaternion
    qvel: Row[float]
    xpos: Row[wp.vec3]
    geom_xpos: Row[wp.vec3]
    site_xpos: Row[wp.vec3]
    memory: Row[float]  # steps that the ball has spent at the goal without a break


@wp.struct
class Params:
    dt: float
    far: float = 0.5  # longer distances count as this, in m
    near: float = 0.03  # of the palm, from which on the goal counts
    finger_weight: float = 0.1
    success_distance: float = 0.05
    success_time: float = 0.2
    start_range: wp.vec2 = wp.vec2(0.15, 0.1)
    ball: int = lw.body("table/ball")
    ball_qpos: int = lw.qpos("table/ball")
    ball_dof: int = lw.dof("table/ball")
    goal: int = lw.site("table/goal")
    palm: int = lw.site("hand/pinchsite")
    finger_1: int = lw.geom("hand/finger_tip_1")
    finger_2: int = lw.geom("hand/finger_tip_2")
    finger_3: int = lw.geom("hand/finger_tip_3")


@wp.func
def distance(s: World, p: Params, point: wp.vec3) -> float:
    """From the ball to a point, clipped."""
    return wp.min(wp.length(point - s.xpos[p.ball]), p.far)


@wp.func
def terms(s: World, p: Params) -> wp.vec3:
    """Distances from the ball: the palm's, the goal's, and the sum of the fingers'."""
    fingers = distance(s, p, s.geom_xpos[p.finger_1]) + distance(s, p, s.geom_xpos[p.finger_2])
    return wp.vec3(
        distance(s, p, s.site_xpos[p.palm]),
        distance(s, p, s.site_xpos[p.goal]),
        fingers + distance(s, p, s.geom_xpos[p.finger_3]),
    )


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    ball = s.xpos[p.ball]
    k = lw.put(obs, 0, s.qpos, 0, p.ball_qpos)
    k = lw.put(obs, k, s.qvel, 0, p.ball_dof)
    k = lw.put(obs, k, ball)
    k = lw.put(obs, k, s.qvel, p.ball_dof, p.ball_dof + 3)
    k = lw.put(obs, k, s.site_xpos[p.palm] - ball)
    k = lw.put(obs, k, s.site_xpos[p.goal] - ball)
    k = lw.put(obs, k, s.geom_xpos[p.finger_1] - ball)
    k = lw.put(obs, k, s.geom_xpos[p.finger_2] - ball)
    k = lw.put(obs, k, s.geom_xpos[p.finger_3] - ball)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    t = terms(s1, p)
    if t[0] < p.near:
        return 2.0 - 2.0 * t[1] / p.far - p.finger_weight * t[2]
    return -t[0] / p.far


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.xpos[p.ball][2]


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    there = distance(s1, p, s1.site_xpos[p.goal]) < p.success_distance
    s1.memory[0] = wp.where(there, s0.memory[0] + 1.0, 0.0)


@wp.func
def success(s: World, p: Params) -> bool:
    return s.memory[0] * p.dt >= p.success_time


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(2):
        s.qpos[p.ball_qpos + i] = lw.uniform(rng, -p.start_range[i], p.start_range[i])


@lw.register
class ArmHandPickup(lw.Task):
    model = lw.package_model("dm_control", "third_party/kinova/jaco_arm.xml", install="lyceum-warp[jaco]")
    keyframe = "home"
    frame_skip = 4
    obs = {"joints": 9, "velocity": 9, "ball": 3, "ball_velocity": 3, "palm": 3, "goal": 3, "fingers": 9}
    metrics = ("palm_distance", "goal_distance", "finger_distances")
    horizon = 300
    memory = 1
    action_range = (-1.0, 1.0)
    planning = lw.Planning(settings={"horizon": 24, "samples": 64, "temperature": 0.3, "noise": 0.8})

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Put the arm at a table, give it a hand, and motors that hold the speed of a joint."""
        spec.attach(HAND.spec(), site=spec.site("wristsite"), prefix="hand/")
        option = spec.option
        option.timestep = 0.005
        option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        option.impratio = 10
        option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        spec.body("b_base").pos = (0, -0.4, 0)
        for geom in spec.geoms:
            geom.contype, geom.conaffinity = 0, 1
        joints = spec.joints
        for i, joint in enumerate(joints):
            # the published limits of large joints, small joints and fingers, in rad/s and N m
            gain, speed, torque = ((500, 0.628, 30.5), (500, 0.838, 6.8), (100, 1.0, 1.0))[i // 3]
            motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.set_to_velocity(kv=gain)
            motor.ctrllimited, motor.ctrlrange = True, (-speed, speed)
            motor.forcelimited, motor.forcerange = True, (-torque, torque)
        scene = mujoco.MjSpec.from_file(str(Path(__file__).with_name("arm_hand_pickup.xml")))
        spec.attach(scene, frame=spec.worldbody.add_frame(), prefix="table/")
        spec.add_key(name="home", qpos=[*HOME, 0, 0, 0.035, 1, 0, 0, 0])
