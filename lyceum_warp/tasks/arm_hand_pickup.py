"""ArmHandPickup: pick up a ball with an arm and a hand, and hold it at a goal (Lyceum's ArmHandPickup).

The arm and the hand are the Kinova Jaco. Install the extra "dm-control" to get their model. Goal, reward and initial
states are Lyceum's, except for the distance from the ball to the goal. Lyceum's code uses |ball - (ball - goal)|, which
is constant. Actions are joint velocities. Success: the ball has been within 5 cm of the goal for ten consecutive steps,
0.2 s.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


def jaco(file: str) -> lw.ModelFile:
    file = f"third_party/kinova/{file}"
    return lw.package_model("dm_control", file, install="lyceum-warp[dm-control]", before_python="3.13")


@wp.struct
class World:
    qpos: Row[float]  # 6 joints of the arm, 3 of the fingers, position and quaternion of the ball
    qvel: Row[float]
    xpos: Row[wp.vec3]
    geom_xpos: Row[wp.vec3]
    site_xpos: Row[wp.vec3]


@wp.struct
class Params:
    far: float = 0.5  # m; larger distances are clipped to this value
    near: float = 0.03  # m; the goal is rewarded only while the palm is closer to the ball
    finger_weight: float = 0.1
    success_distance: float = 0.05
    ball: int = lw.body("table/ball")
    goal: int = lw.site("table/goal")
    palm: int = lw.site("hand/pinchsite")
    finger: int = lw.geom("hand/finger_tip_1")  # the other fingertips are finger + 2 and finger + 4


@wp.func
# the ball's distances from the palm and from the goal, and the sum of its distances from the fingertips
def distances(s: World, p: Params) -> wp.vec3:
    d = wp.vec3(wp.length(s.site_xpos[p.palm] - s.xpos[p.ball]), wp.length(s.site_xpos[p.goal] - s.xpos[p.ball]), 0.0)
    d = wp.min(d, wp.vec3(p.far))
    for i in range(3):
        d[2] += wp.min(wp.length(s.geom_xpos[p.finger + 2 * i] - s.xpos[p.ball]), p.far)
    return d


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    ball = s.xpos[p.ball]
    k = lw.put(obs, 0, s.qpos, 0, 9)
    k = lw.put(obs, k, s.qvel, 0, 12)
    k = lw.put(obs, k, ball)
    k = lw.put(obs, k, s.site_xpos[p.palm] - ball)
    k = lw.put(obs, k, s.site_xpos[p.goal] - ball)
    for i in range(3):
        k = lw.put(obs, k, s.geom_xpos[p.finger + 2 * i] - ball)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    d = distances(s1, p)
    return wp.where(d[0] < p.near, 2.0 - 2.0 * d[1] / p.far - p.finger_weight * d[2], -d[0] / p.far)


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, distances(s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.xpos[p.ball][2]


@wp.func
def success(s: World, p: Params) -> bool:
    return distances(s, p)[1] < p.success_distance


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[9] = lw.uniform(rng, -0.15, 0.15)
    s.qpos[10] = lw.uniform(rng, -0.1, 0.1)


@lw.register
class ArmHandPickup(lw.Task):
    model = jaco("jaco_arm.xml")
    keyframe = "home"
    frame_skip, horizon, success_steps = 4, 300, 10
    obs = {"joints": 9, "velocity": 9, "ball_velocity": 3, "ball": 3, "palm": 3, "goal": 3, "fingers": 9}
    metrics, action_range = ("palm_distance", "goal_distance", "finger_distances"), (-1.0, 1.0)
    # planners get larger values of ``far`` and ``finger_weight``
    planning = lw.Planning(
        settings=dict(horizon=32, samples=64, temperature=0.1, noise=0.8, fill="repeat", include_plan=False),
        params={"far": 1.0, "finger_weight": 2.0},
    )

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        spec.attach(jaco("jaco_hand.xml").spec(), site=spec.site("wristsite"), prefix="hand/")
        for geom in spec.geoms:
            geom.contype, geom.conaffinity = 0, 1
        # for large joints, small joints and fingers: gain, maximum rad/s and maximum N m
        for i, joint in enumerate(spec.joints):
            gain, speed, torque = ((500, 0.628, 30.5), (500, 0.838, 6.8), (100, 1.0, 1.0))[i // 3]
            motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.set_to_velocity(kv=gain)
            motor.ctrlrange, motor.forcerange = (-speed, speed), (-torque, torque)
        spec.body("b_base").pos = (0, -0.4, 0)
        scene = lw.package_model("lyceum_warp", "tasks/arm_hand_pickup.xml").spec()
        spec.option = scene.option
        spec.attach(scene, frame=spec.worldbody.add_frame(), prefix="table/")
        above = (1.775, 3.682, 1.303, 3.395, 5.351, 3.133, 0.2, 0.2, 0.2)  # the open hand points down, above the ball
        spec.add_key(name="home", qpos=[*above, 0, 0, 0.035, 1, 0, 0, 0])
