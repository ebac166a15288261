"""HumanoidStand: Gymnasium's humanoid stands, and steps to keep its balance when it is pushed.

Actions are offsets of the joints' targets from a default pose with bent knees. The motors act as servos at the control
rate, within Gymnasium's torque limits. The feet are spheres, so the robot can only balance by stepping and by swinging
its body. Balance is measured by the distance of the capture point from the line between the feet. A foot at the capture
point would stop the robot (Pratt et al. 2006, "Capture point: a step toward humanoid push recovery").

At each of ``push_times``, the robot gets an impulse in a random horizontal direction: the velocities of all bodies
change by impulse / mass. Planners do not foresee pushes.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms
from lyceum_warp.terms import base_height, gravity, joint_velocity_l2, too_low  # noqa: F401

LEG = ("hip_x", "hip_z", "hip_y", "knee")
ARM = ("shoulder1", "shoulder2", "elbow")
JOINTS = ("abdomen_z", "abdomen_y", "abdomen_x", *(f"{side}_{name}" for name_of in (LEG, ARM)
          for side in ("right", "left") for name in name_of))  # fmt: skip


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    time: float
    subtree_com: Row[wp.vec3]
    geom_xpos: Row[wp.vec3]


@wp.struct
class Params:
    dt: float
    joint_qpos: wp.array[int] = lw.qposes(*JOINTS)
    joint_dof: wp.array[int] = lw.dofs(*JOINTS)
    motors: wp.array[int] = lw.actuators(*JOINTS)
    right_foot: int = lw.geom("right_foot")
    left_foot: int = lw.geom("left_foot")
    # servos
    default_pose: wp.array[float] = [*3 * [0.0], *2 * [-0.05, 0.0, -0.3, -0.65], *2 * [0.0, 0.0, -0.8]]  # rad
    action_scale: wp.array[float] = [*3 * [0.5], *2 * [0.5, 0.5, 1.0, 1.0], *6 * [1.0]]  # rad
    stiffness: wp.array[float] = [*3 * [80.0], *2 * [60.0, 60.0, 150.0, 100.0], *6 * [10.0]]  # N m / rad
    damping: wp.array[float] = [*3 * [0.0], *2 * [0.0, 0.0, 0.0, 4.0], *6 * [0.0]]  # N m s / rad
    gear: wp.array[float] = lw.from_model(lambda model, p: [float(model.actuator_gear[i, 0]) for i in p.motors])
    # reward terms
    forward_speed: float = 0.0  # m/s
    target_height: float = 1.22  # of the torso, m
    least_height: float = 0.8
    # starts and pushes
    start_noise: float = 0.02  # rad, and rad/s
    push_times: wp.array[float] = [5.0, 10.0, 15.0]  # s
    push_impulse: wp.vec2 = wp.vec2(10.0, 20.0)  # N s
    mass: float = lw.from_model(lambda model, p: float(model.body_subtreemass[0]))


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for j in range(p.motors.shape[0]):
        target = p.default_pose[j] + p.action_scale[j] * action[j]
        q, qdot = s.qpos[p.joint_qpos[j]], s.qvel[p.joint_dof[j]]
        torque = terms.servo_torque(target, q, qdot, p.stiffness[j], p.damping[j])
        ctrl[p.motors[j]] = torque / p.gear[j]


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 2, 24)
    lw.put(obs, k, s.qvel)


@wp.func
def velocity(s0: World, s1: World, p: Params) -> wp.vec2:  # velocity of the centre of mass, minus the desired velocity
    moved = (s1.subtree_com[0] - s0.subtree_com[0]) / p.dt
    return wp.vec2(moved[0] - p.forward_speed, moved[1])


# reward terms; their arguments are found by name


@wp.func
def height_l2(base_height: float, p: Params) -> float:
    return (base_height - p.target_height) * (base_height - p.target_height)


@wp.func
def lean(gravity: wp.vec3) -> float:  # from 0, upright, to 2
    return 1.0 + gravity[2]


@wp.func
def turned(qpos: Row[float]) -> float:  # from 0, facing x, to 2
    return 1.0 - wp.cos(terms.heading(qpos))


@wp.func
def velocity_l2(velocity: wp.vec2) -> float:
    return wp.length_sq(velocity)


@wp.func
def capture_l2(velocity: wp.vec2, s1: World, p: Params) -> float:
    """Return the capture point's squared distance from the middle 60 % of the line between the feet, at most 1 m^2."""
    com, a, b = s1.subtree_com[0], s1.geom_xpos[p.right_foot], s1.geom_xpos[p.left_foot]
    seconds = wp.sqrt(wp.max(com[2], 0.1) / 9.81)  # the time constant of a linear inverted pendulum
    point = wp.vec2(com[0] - a[0], com[1] - a[1]) + seconds * velocity
    line = wp.vec2(b[0] - a[0], b[1] - a[1])
    share = wp.clamp(wp.dot(point, line) / (wp.length_sq(line) + 1e-6), 0.2, 0.8)
    return wp.min(wp.length_sq(point - share * line), 1.0)


@wp.func
def pose_l2(s1: World, p: Params) -> float:
    total = float(0.0)
    for j in range(p.joint_qpos.shape[0]):
        error = s1.qpos[p.joint_qpos[j]] - p.default_pose[j]
        total += error * error
    return total


@wp.func
def action_l2(action: Row[float]) -> float:
    return lw.sum_squares(action)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.qpos[2]


@wp.func
def initialize(s: World, p: Params):
    lw.put_upright(s.qpos, 0, wp.vec3(0.0, 0.0, 1.25), 0.0)
    for j in range(p.joint_qpos.shape[0]):
        s.qpos[p.joint_qpos[j]] = p.default_pose[j]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for j in range(p.joint_qpos.shape[0]):
        s.qpos[p.joint_qpos[j]] += lw.uniform(rng, -p.start_noise, p.start_noise)
    for i in range(s.qvel.shape[0]):
        s.qvel[i] += lw.uniform(rng, -p.start_noise, p.start_noise)


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    for k in range(p.push_times.shape[0]):
        if wp.abs(s.time - p.push_times[k]) < 0.5 * p.dt:
            direction = lw.uniform(rng, -wp.pi, wp.pi)
            speed = lw.uniform(rng, p.push_impulse[0], p.push_impulse[1]) / p.mass
            s.qvel[0] += speed * wp.cos(direction)
            s.qvel[1] += speed * wp.sin(direction)


@lw.register
class HumanoidStand(lw.Task):
    model, frame_skip, horizon = "humanoid.xml", 5, 1333  # 20 s
    obs, actions = {"position": 22, "velocity": 23}, {"joint_target": "motors"}
    lagged = ("subtree_com", "geom_xpos")
    rewards = {
        "alive": 1.0,
        "height_l2": -10.0,
        "lean": -10.0,
        "capture_l2": -20.0,
        "velocity_l2": -2.0,
        "turned": -2.0,
        "pose_l2": -0.3,
        "joint_velocity_l2": -0.002,
        "action_l2": -0.02,
    }
    terminations = ("too_low",)
    physics = {"fast": lw.PhysicsOptions(integrator="implicitfast", timestep=0.015, frame_skip=1)}
    planning = lw.Planning(
        settings=dict(horizon=40, samples=24, knots=8, noise=0.15, temperature=0.0075), options={"physics": "fast"}
    )


alive = terms.alive


@wp.struct
class WalkParams(Params):
    forward_speed: float = 0.8


@wp.func
def evaluate_distance(s: World, p: Params) -> float:
    return s.qpos[0]


@lw.register
class HumanoidWalk(HumanoidStand):
    """Gymnasium's humanoid walks forward, and keeps its balance when it is pushed."""

    Params, evaluate = WalkParams, evaluate_distance


@wp.struct
class GetUpParams(Params):
    push_times: wp.array[float] = [15.0]


@wp.func
def lie_down(s: World, p: Params):
    s.qpos[2] = 0.15


@wp.func
def turn_over(s: World, p: Params, rng: Row[wp.uint32]):
    """Start on the back or on the front."""
    angle = wp.where(lw.uniform(rng, 0.0, 1.0) < 0.5, -0.5 * wp.pi, 0.5 * wp.pi)
    lw.put(s.qpos, 3, lw.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), angle + lw.uniform(rng, -0.1, 0.1)))
    for j in range(p.joint_qpos.shape[0]):
        s.qpos[p.joint_qpos[j]] += lw.uniform(rng, -p.start_noise, p.start_noise)


@wp.func
def stands(s: World, p: Params) -> bool:
    return s.qpos[2] > 1.1


@lw.register
class HumanoidGetUp(HumanoidStand):
    """Gymnasium's humanoid gets up from its back or its front, and succeeds if it stands for a second."""

    Params, initialize, randomize, success = GetUpParams, lie_down, turn_over, stands
    terminations, success_steps = (), 67
    rewards = HumanoidStand.rewards | {
        "height_l2": -30.0,
        "capture_l2": -8.0,
        "velocity_l2": -0.5,
        "turned": 0.0,
        "pose_l2": -0.1,
        "joint_velocity_l2": 0.0,
    }
    planning = lw.Planning(
        settings=dict(horizon=40, samples=24, knots=5, noise=0.3, temperature=0.02), options={"physics": "fast"}
    )
