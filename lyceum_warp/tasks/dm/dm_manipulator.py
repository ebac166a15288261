"""ManipulatorBringBall: a planar arm with a hand brings a ball to a target."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite

ARM = ("arm_root", "arm_shoulder", "arm_elbow", "arm_wrist", "finger", "fingertip", "thumb", "thumbtip")
BALL = ("ball_x", "ball_z", "ball_y")
TOUCH = ("palm_touch", "finger_touch", "thumb_touch", "fingertip_touch", "thumbtip_touch")
IN_HAND, IN_TARGET = wp.constant(0.1), wp.constant(0.1)  # probabilities of the ball's initial positions


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    xpos: Row[wp.vec3]
    xquat: Row[lw.quat]
    site_xpos: Row[wp.vec3]
    sensordata: Row[float]
    mocap_pos: Row[wp.vec3]
    mocap_quat: Row[lw.quat]


@wp.struct
class Params:
    close: float = 0.01  # m
    arm: wp.array[int] = lw.qposes(*ARM)
    arm_dof: wp.array[int] = lw.dofs(*ARM)
    arm_range: wp.array[wp.vec2] = lw.from_model(
        lambda model, p: [
            joint.range if model.jnt_limited[joint.id] else (-wp.pi, wp.pi) for joint in map(model.joint, ARM)
        ]
    )  # of the arm's joints, rad
    links: wp.vec4 = wp.vec4(0.18, 0.15, 0.12, 0.065)  # lengths of the links, m
    root: wp.vec3 = lw.from_model(lambda model, p: model.body("upper_arm").pos)  # of the arm, m
    ball_qpos: wp.array[int] = lw.qposes(*BALL)
    ball_dof: wp.array[int] = lw.dofs(*BALL)
    touch: wp.array[int] = lw.sensors(*TOUCH)
    contacts: int = lw.sensor("contacts")
    hand: int = lw.body("hand")
    ball: int = lw.body("ball")
    target_body: int = lw.body("target_ball")
    target: int = lw.mocap("target_ball")
    ball_site: int = lw.site("ball")
    target_site: int = lw.site("target_ball")


@wp.func
def pose(s: World, body: int) -> wp.vec4:  # x and z of the position, w and y of the quaternion
    return wp.vec4(s.xpos[body][0], s.xpos[body][2], s.xquat[body][0], s.xquat[body][2])


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = int(0)
    for j in range(p.arm.shape[0]):
        angle = s.qpos[p.arm[j]]
        k = lw.put(obs, k, wp.vec2(wp.sin(angle), wp.cos(angle)))
    for j in range(p.arm_dof.shape[0]):
        k = lw.put(obs, k, s.qvel[p.arm_dof[j]])
    for j in range(p.touch.shape[0]):
        k = lw.put(obs, k, suite.log1p(s.sensordata[p.touch[j]]))
    k = lw.put(obs, k, pose(s, p.hand))
    k = lw.put(obs, k, pose(s, p.ball))
    for j in range(p.ball_dof.shape[0]):
        k = lw.put(obs, k, s.qvel[p.ball_dof[j]])
    lw.put(obs, k, pose(s, p.target_body))


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    distance = wp.length(s1.site_xpos[p.target_site] - s1.site_xpos[p.ball_site])
    return lw.tolerance(distance, wp.vec2(0.0, p.close), 2.0 * p.close)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for j in range(p.arm.shape[0]):
        s.qpos[p.arm[j]] = lw.uniform(rng, p.arm_range[j][0], p.arm_range[j][1])
    s.qpos[p.arm[4]] = s.qpos[p.arm[6]]  # the finger mirrors the thumb
    x, z = lw.uniform(rng, -0.4, 0.4), lw.uniform(rng, 0.1, 0.4)
    angle = lw.uniform(rng, -wp.pi, wp.pi)
    s.mocap_pos[p.target][0] = x
    s.mocap_pos[p.target][2] = z
    s.mocap_quat[p.target] = wp.vec4(wp.cos(angle / 2.0), 0.0, wp.sin(angle / 2.0), 0.0)
    kind = lw.uniform(rng, 0.0, 1.0)
    if kind < IN_HAND:
        x, z, turned = p.root[0], p.root[2], float(0.0)
        for j in range(4):
            turned += s.qpos[p.arm[j]]
            x -= p.links[j] * wp.sin(turned)
            z += p.links[j] * wp.cos(turned)
        angle = wp.pi - wp.atan2(wp.sin(turned), wp.cos(turned))
    elif kind >= IN_HAND + IN_TARGET:
        x, z = lw.uniform(rng, -0.5, 0.5), lw.uniform(rng, 0.0, 0.7)
        angle = lw.uniform(rng, 0.0, 2.0 * wp.pi)
        s.qvel[p.ball_dof[0]] = lw.uniform(rng, -5.0, 5.0)
    s.qpos[p.ball_qpos[0]] = x
    s.qpos[p.ball_qpos[1]] = z
    s.qpos[p.ball_qpos[2]] = angle


@wp.func
def reject(s: World, p: Params) -> bool:
    return s.sensordata[p.contacts] > 0.0


@lw.register
class ManipulatorBringBall(lw.Task):
    model, frame_skip, draws = suite.model("manipulator"), 10, 20
    obs = {"arm_pos": 16, "arm_vel": 8, "touch": 5, "hand_pos": 4, "object_pos": 4, "object_vel": 3, "target_pos": 4}

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Add a sensor for contacts (see ``reject``), give each world its own target, and remove unused objects.

        Also add a keyframe with the ball in the hand. MuJoCo Warp's buffers get their sizes from simulations that start
        at each keyframe. Without this keyframe, the buffers would be too small.
        """
        suite.count_contacts(spec)
        for name in ("peg", "target_peg", "cup", "slot"):
            spec.delete(spec.body(name))
        spec.body("target_ball").mocap = True
        spec.add_key(name="grasped", qpos=[2.66, -0.56, 1.58, -1.56, 0.61, -0.29, 0.6, -0.32, -0.14, 0.02, 0.0])
