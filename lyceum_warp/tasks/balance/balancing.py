"""Define what the tasks of this folder share: rewards for balance, and pushes.

Balance is measured by the distance of the capture point from the line between the feet. A foot at the capture point
would stop the robot (Pratt et al. 2006, "Capture point: a step toward humanoid push recovery").

At each of ``push_times``, an impulse pushes the robot in a random horizontal direction. It changes the velocity of the
whole robot by impulse / mass. Planners do not foresee pushes.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms
from lyceum_warp.terms import alive, base_height, gravity, joint_velocity_l2, pose_l2, too_low  # noqa: F401


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    time: float
    subtree_com: Row[wp.vec3]
    site_xpos: Row[wp.vec3]


@wp.struct
class Params:
    dt: float  # seconds in a step
    joint_qpos: wp.array[int] = lw.qposes()  # of the actuated joints
    joint_dof: wp.array[int] = lw.dofs()  # of the actuated joints
    motors: wp.array[int] = lw.actuators()  # of these joints
    right_foot: int = lw.site("right_foot")  # the site
    left_foot: int = lw.site("left_foot")  # the site
    default_pose: wp.array[float] = [0.0]  # rad
    action_scale: wp.array[float] = [1.0]  # rad
    # reward terms
    forward_speed: float = 0.0  # m/s
    target_height: float = 1.0  # of the base, m
    least_height: float = 0.5  # of the base; an episode ends below it, m
    # starts and pushes
    start_height: float = 1.0  # of the base, m
    start_noise: float = 0.02  # rad, and rad/s
    push_times: wp.array[float] = [5.0, 10.0, 15.0]  # s
    push_impulse: wp.vec2 = wp.vec2(10.0, 20.0)  # N s
    mass: float = lw.from_model(lambda model, p: float(model.body_subtreemass[0]))  # of the robot, kg


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 2, s.qpos.shape[0])
    lw.put(obs, k, s.qvel)


@wp.func
def velocity(s0: World, s1: World, p: Params) -> wp.vec2:  # velocity of the centre of mass, minus the desired velocity
    moved = (s1.subtree_com[0] - s0.subtree_com[0]) / p.dt
    return wp.vec2(moved[0] - p.forward_speed, moved[1])


height_l2 = terms.base_height_l2


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
    com, a, b = s1.subtree_com[0], s1.site_xpos[p.right_foot], s1.site_xpos[p.left_foot]
    seconds = wp.sqrt(wp.max(com[2], 0.1) / 9.81)  # the time constant of a linear inverted pendulum
    point = wp.vec2(com[0] - a[0], com[1] - a[1]) + seconds * velocity
    line = wp.vec2(b[0] - a[0], b[1] - a[1])
    share = wp.clamp(wp.dot(point, line) / (wp.length_sq(line) + 1e-6), 0.2, 0.8)
    return wp.min(wp.length_sq(point - share * line), 1.0)


@wp.func
def action_l2(action: Row[float]) -> float:
    return lw.sum_squares(action)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.qpos[2]


@wp.func
def evaluate_distance(s: World, p: Params) -> float:
    return s.qpos[0]


@wp.func
def initialize(s: World, p: Params):
    lw.put_upright(s.qpos, 0, wp.vec3(0.0, 0.0, p.start_height), 0.0)
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


class Balance(lw.Task):
    """A robot keeps its balance when it is pushed."""

    lagged = ("subtree_com", "site_xpos")
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

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Put a site at each foot. Geoms in the state would break planners whose models have no visual geoms."""
        for name in ("right_foot", "left_foot"):
            geom = spec.geom(name)
            (spec.site(name) or geom.parent.add_site(name=name)).pos = geom.pos
