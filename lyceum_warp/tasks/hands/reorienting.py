"""Define in-hand reorientation: turn an object to goals, as in MuJoCo Playground's LeapCubeReorient.

The goal is a mocap body ``goal``. After a success, it turns to a new orientation within a second, and the episode goes
on. An action changes the servos' targets. The differences from Playground are those of ``rotating``.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms
from lyceum_warp.tasks.hands import gates, rotating
from lyceum_warp.tasks.hands.rotating import position, put_axes, rotation
from lyceum_warp.terms import absolute_power, pose_l2  # noqa: F401


@wp.struct
class World(rotating.World):
    body_iquat: Row[lw.quat]
    qfrc_actuator: Row[float]
    mocap_quat: Row[lw.quat]
    target: Row[float] = lw.memory("joints")  # of the servos, rad
    goal_spin: Row[wp.vec3] = lw.memory()  # angular velocity of the goal in its own axes, rad/s
    previous_action: Row[float] = lw.memory("joints")
    success_angle: Row[float] = lw.lasting_memory()  # rad


@wp.struct
class Params(rotating.Params):
    goal: int = lw.mocap("goal")
    target_range: wp.array[wp.vec2] = lw.from_model(lambda model, p: model.actuator_ctrlrange[p.servos])  # rad
    action_scale: float = 0.5  # rad for an action of 1
    goal_angle: wp.vec2 = wp.vec2(0.1, 0.8)  # range of the angle at which a world's goal is reached, log-uniform, rad
    goal_speed: wp.vec2 = wp.vec2(1.0, 5.0)  # range of the goal's first angular velocity about each axis, rad/s
    goal_decay: float = 0.8  # factor of the goal's angular velocity in each step
    # noise on the policy's observations
    object_position_noise: float = 0.02  # bound of the uniform noise, m
    object_rotation_noise: float = 0.02  # standard deviation of the noise on the quaternion's elements


@wp.struct
class Policy(rotating.Policy):
    target_error: Row[float] = lw.part("joints")  # rad
    object_position: Row[wp.vec3] = lw.part()  # from the palm's site
    object_axes: Row[wp.vec3] = lw.part(2)  # relative to the goal
    object_sides: Row[wp.vec3] = lw.part(3)  # of the box with the object's mass and inertia, m


@wp.struct
class Critic(rotating.Critic):
    target_error: Row[float] = lw.part("joints")
    object_sides: Row[wp.vec3] = lw.part(3)


@wp.func
def goal_error(turn: lw.quat, s: World, p: Params) -> lw.quat:
    """Return the rotation from the goal to an orientation."""
    return lw.quat_mul(turn, lw.quat_inverse(s.mocap_quat[p.goal]))


@wp.func
def angle(s: World, p: Params) -> float:  # between object and goal, rad
    return lw.quat_angle(rotation(s, p), s.mocap_quat[p.goal])


@wp.func
def put_sides(sides: Row[wp.vec3], turn: lw.quat, s: World, p: Params):
    """Write three sides of the box that has the object's mass and inertia, for an orientation of the object."""
    body = p.object[0]
    inertia = s.body_inertia[body]
    m = lw.quat_to_mat(lw.quat_mul(turn, s.body_iquat[body]))
    for i in range(3):
        square = 6.0 * (inertia[0] + inertia[1] + inertia[2] - 2.0 * inertia[i]) / s.body_mass[body]
        sides[i] = wp.sqrt(wp.max(square, 0.0)) * wp.vec3(m[0, i], m[1, i], m[2, i])


# actions and observations


@wp.func
def moved(s: World, action: Row[float], p: Params, j: int) -> float:
    """Return a servo's target after an action."""
    target = s.target[j] + p.action_scale * rotating.clipped(action, j)
    return wp.clamp(target, p.target_range[j][0], p.target_range[j][1])


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for j in range(p.joints.shape[0]):
        ctrl[p.servos[j]] = moved(s, action, p, j)


@wp.func
def observe(s: World, p: Params, obs: Policy, rng: Row[wp.uint32]):
    rotating.observe(s, p, obs, rng)
    for j in range(p.joints.shape[0]):
        obs.target_error[j] = obs.joint_position[j] - s.target[j]
    noise = wp.vec3(p.object_position_noise)
    obs.object_position[0] = position(s, p) - s.site_xpos[p.palm] + lw.uniform(rng, -noise, noise)
    turn = rotation(s, p)
    for i in range(4):
        turn[i] += p.object_rotation_noise * lw.normal(rng)
    turn = wp.normalize(turn)
    put_axes(obs.object_axes, goal_error(turn, s, p))
    put_sides(obs.object_sides, turn, s, p)


@wp.func
def observe_critic(s: World, p: Params, obs: Critic):
    rotating.observe_exactly(s, p, obs)
    for j in range(p.joints.shape[0]):
        obs.target_error[j] = obs.joint_position[j] - s.target[j]
    put_axes(obs.object_axes, goal_error(rotation(s, p), s, p))
    put_sides(obs.object_sides, rotation(s, p), s, p)


# between steps


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    for j in range(p.joints.shape[0]):
        s1.target[j] = moved(s0, action, p, j)
    lw.put(s1.previous_action, 0, s0.last_action)
    rotating.advance(s0, action, s1, p, rng)


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    if success(s, p):
        s.goal_spin[0] = lw.uniform(rng, wp.vec3(p.goal_speed[0]), wp.vec3(p.goal_speed[1]))
    else:
        s.goal_spin[0] = p.goal_decay * s.goal_spin[0]
    turn = lw.quat_from_rotvec(2.0 * p.dt * s.goal_spin[0])
    s.mocap_quat[p.goal] = lw.quat_mul(s.mocap_quat[p.goal], turn)


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    rotating.startup(s, p, rng)
    s.success_angle[0] = terms.log_uniform(rng, p.goal_angle[0], p.goal_angle[1])


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    rotating.randomize(s, p, rng)
    terms.gather(s.target, s.qpos, p.joint_qpos)
    s.mocap_quat[p.goal] = lw.quat_random(rng)


# terms


@wp.func
def success(s: World, p: Params) -> bool:
    return angle(s, p) < s.success_angle[0]


@wp.func
def aligned(s: World, p: Params) -> float:
    return lw.tolerance(angle(s, p), wp.vec2(0.0, 0.2), wp.pi, lw.Sigmoid.LINEAR)


@wp.func
def progress(s0: World, s1: World, p: Params) -> float:  # rad/s
    turn = lw.quat_angle(rotation(s0, p), s0.mocap_quat[p.goal]) - lw.quat_angle(rotation(s1, p), s0.mocap_quat[p.goal])
    return turn / p.dt


@wp.func
def centred(s: World, p: Params) -> float:
    distance = wp.length(position(s, p) - s.site_xpos[p.palm])
    return lw.tolerance(distance, wp.vec2(0.0, 0.02), 0.05, lw.Sigmoid.LINEAR)


@wp.func
def goals(s: World, p: Params) -> float:
    return wp.where(success(s, p), 1.0, 0.0)


@wp.func
def action_rate(s0: World, action: Row[float]) -> float:
    return terms.action_rate_l2(action, s0.last_action) + terms.action_acceleration_l2(
        action, s0.last_action, s0.previous_action
    )


@wp.func
def evaluate(s: World, p: Params) -> float:
    return angle(s, p)


class Reorient(rotating.Rotate):
    """A hand turns an object to a goal, then to the next, and does not drop it."""

    horizon = 1000
    gate = gates.Turns("success", "goals reached", least=2.0, drops=20.0, goal_angle=[0.1, 0.1])
    rewards = {
        "aligned": 0.1,
        "progress": 1.0,
        "centred": 0.05,
        "goals": 200.0,  # 10 for each
        "drop": -10.0,
        "pose_l2": -0.05,
        "action_rate": -1e-4,
        "absolute_power": -1e-4,
        "excess_l2": -0.1,
    }
    metrics = ("success",)
    planning = lw.Planning(
        settings={"horizon": 12, "samples": 128, "temperature": 0.05, "noise": 0.3},
        params={"goal_angle": [0.1, 0.1], "drop": -2000.0, "centred": 2.0},
    )
    cleared = ("qfrc_actuator",)
    training = lw.Training(
        algorithm="ppo",
        iterations=1200,
        settings={"log_std": -0.7, "entropy_coef": 0.001},
    )
