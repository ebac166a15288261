"""Go1Velocity: a Unitree Go1 walks at a commanded velocity, as in mjlab 1.6.0's Mjlab-Velocity-Flat-Unitree-Go1.

Observations, rewards, commands, pushes and resets have mjlab's numbers; docs/go1.md lists the differences. Actions are
offsets of the joints' servo targets from the default pose. Joints and feet are in the order FR, FL, RR, RL, with hip,
thigh and calf for each leg.

Functions read the state after the last substep. Only the forces on the feet are from the beginning of that substep, and
0 at the start of an episode. Feet are spheres on a plane, so a foot is in contact if its height is at most its radius.

Loops over legs are written range(int(4)), which Warp does not unroll: unrolled, the GPU kernels have three times as
many instructions and are limited by instruction fetches.
"""

import math

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # pose of the trunk, then 12 joints
    qvel: Row[float]
    sensordata: Row[float]  # forces of the feet on the floor, in the world's axes, N
    body_pos: Row[wp.vec3]
    body_ipos: Row[wp.vec3]
    jnt_axis: Row[wp.vec3]
    jnt_range: Row[wp.vec2]
    site_pos: Row[wp.vec3]
    geom_size: Row[wp.vec3]
    geom_friction: Row[wp.vec3]
    actuator_gainprm: Row[lw.vec10]
    actuator_forcerange: Row[wp.vec2]
    drawn_velocity: Row[float] = lw.memory(3)  # commanded forward and lateral velocity and yaw rate, as drawn
    heading_target: Row[float] = lw.memory()  # rad
    heading_controlled: Row[float] = lw.memory()  # 1 if the heading determines the yaw rate
    standing: Row[float] = lw.memory()  # 1 if the command is to stand
    command_timer: Row[float] = lw.memory()  # seconds until a new command
    push_timer: Row[float] = lw.memory()  # seconds until a push
    last_action: Row[float] = lw.memory(12)
    contact_time: Row[float] = lw.memory(4)  # seconds since each foot came into contact; 0 in the air
    air_time: Row[float] = lw.memory(4)  # seconds since each foot left the floor; 0 in contact
    encoder_bias: Row[float] = lw.lasting_memory(12)  # of the joints, rad
    peak_height: Row[float] = lw.lasting_memory(4)  # of each foot since its last landing, m
    env_steps: Row[float] = lw.lasting_memory()


@wp.struct
class Params:
    dt: float
    substep_dt: float
    # weights of the reward terms, per second
    track_linear_velocity: float = 2.0
    track_angular_velocity: float = 2.0
    upright: float = 1.0
    pose: float = 1.0
    dof_pos_limits: float = -1.0
    action_rate_l2: float = -0.1
    foot_clearance: float = -2.0
    foot_swing_height: float = -0.25
    foot_slip: float = -0.1
    soft_landing: float = -1e-5
    # scales of the reward terms
    linear_velocity_variance: float = 0.25  # (m/s)^2
    angular_velocity_variance: float = 0.5  # (rad/s)^2
    tilt_variance: float = 0.2
    standing_pose_std: wp.vec3 = wp.vec3(0.05, 0.05, 0.1)  # of hip, thigh and calf, rad
    walking_pose_std: wp.vec3 = wp.vec3(0.3, 0.3, 0.6)
    soft_limit: float = 0.9  # share of a joint's range
    foot_height: float = 0.1  # target height of a swing, m
    least_command: float = 0.05  # below it, the gait terms are 0 and the pose term uses standing_pose_std
    fall_angle: float = math.radians(70.0)
    # actions
    default_pose: wp.array[float] = 2 * [0.1, 0.9, -1.8, -0.1, 0.9, -1.8]  # rad
    action_scale: float = 0.25  # as a share of the angle at which a servo's force reaches its limit
    # commands: first step of the stage, minimum and maximum forward velocity (m/s), maximum yaw rate (rad/s)
    stages: wp.array2d[float] = [[0.0, -1.0, 1.0, 0.5], [120e3, -1.5, 2.0, 0.7], [240e3, -2.0, 3.0, 0.7]]
    lateral_velocity: float = 1.0
    command_seconds: wp.vec2 = wp.vec2(3.0, 8.0)
    heading_share: float = 0.3  # share of commands whose yaw rate follows a heading
    heading_gain: float = 0.5  # 1/s
    standing_share: float = 0.1
    forward_share: float = 0.2  # share of commands that are forward only
    least_forward_velocity: float = 0.3
    # uniform noise of the policy's observations, +-
    linear_velocity_noise: float = 0.5
    angular_velocity_noise: float = 0.2
    gravity_noise: float = 0.05
    joint_position_noise: float = 0.01
    joint_velocity_noise: float = 1.5
    # pushes
    push_seconds: wp.vec2 = wp.vec2(1.0, 3.0)
    push_velocity: wp.vec3 = wp.vec3(0.5, 0.5, 0.4)  # +-, in the world's axes, m/s
    push_spin: wp.vec3 = wp.vec3(0.52, 0.52, 0.78)  # +-, in the world's axes, rad/s
    # differences between robots
    encoder_bias: float = 0.015  # +-, rad
    trunk_offset: wp.vec3 = wp.vec3(0.025, 0.025, 0.03)  # +-, of the trunk's centre of mass, m
    sliding_friction: wp.vec2 = wp.vec2(0.3, 1.5)
    spinning_friction: wp.vec2 = wp.vec2(1e-4, 2e-2)  # log-uniform, like the rolling friction
    rolling_friction: wp.vec2 = wp.vec2(1e-5, 5e-3)
    # resets
    start_height: float = 0.278
    start_low: wp.vec3 = wp.vec3(-0.5, -0.5, 0.01)  # offset of the trunk, m
    start_high: wp.vec3 = wp.vec3(0.5, 0.5, 0.05)
    start_yaw: float = 3.14  # +-
    # elements of the model; the twelve bodies, the twelve joints, the feet's sites and sensors are consecutive
    trunk: int = lw.body("trunk")
    bodies: int = lw.body("FR_hip")
    joints: int = lw.joint("FR_hip")
    imu: int = lw.site("imu")
    feet: int = lw.site("FR_foot")
    forces: int = lw.sensor("FR_force")
    foot_geoms: wp.array[int] = lw.geoms("FR_foot", "FL_foot", "RR_foot", "RL_foot")


# the trunk


@wp.func
def orientation(s: World) -> lw.quat:
    return lw.quat(s.qpos[3], s.qpos[4], s.qpos[5], s.qpos[6])


@wp.func
def linear_velocity(s: World) -> wp.vec3:  # of the trunk's origin, in the trunk's axes
    return lw.quat_rotate_inverse(orientation(s), wp.vec3(s.qvel[0], s.qvel[1], s.qvel[2]))


@wp.func
def angular_velocity(s: World) -> wp.vec3:  # in the trunk's axes
    return wp.vec3(s.qvel[3], s.qvel[4], s.qvel[5])


@wp.func
def gravity(s: World) -> wp.vec3:  # direction of gravity in the trunk's axes
    return lw.quat_rotate_inverse(orientation(s), wp.vec3(0.0, 0.0, -1.0))


@wp.func
def heading(s: World) -> float:
    forward = lw.quat_rotate(orientation(s), wp.vec3(1.0, 0.0, 0.0))
    return wp.atan2(forward[1], forward[0])


# the feet


@wp.func
def foot(s: World, p: Params, leg: int) -> tuple[wp.vec3, wp.vec3]:
    """Position and velocity of a foot in the world, computed from the joints, which saves a forward pass."""
    x, v = wp.vec3(s.site_pos[p.feet + leg]), wp.vec3(0.0)
    for k in range(int(3)):
        j = 3 * leg + 2 - k  # calf, thigh, hip
        axis = s.jnt_axis[p.joints + j]
        turn = lw.quat_from_axis_angle(axis, s.qpos[7 + j])
        x = lw.quat_rotate(turn, x)
        v = lw.quat_rotate(turn, v) + s.qvel[6 + j] * wp.cross(axis, x)
        x += s.body_pos[p.bodies + j]
    v += wp.cross(angular_velocity(s), x)
    quat = orientation(s)
    origin, velocity = wp.vec3(s.qpos[0], s.qpos[1], s.qpos[2]), wp.vec3(s.qvel[0], s.qvel[1], s.qvel[2])
    return origin + lw.quat_rotate(quat, x), velocity + lw.quat_rotate(quat, v)


@wp.func
def height(x: wp.vec3) -> float:  # of a foot's centre; clipped at 1 m, the range of mjlab's rays
    return wp.clamp(x[2], 0.0, 1.0)


@wp.func
def speed(v: wp.vec3) -> float:  # of a foot along the floor
    return wp.length(wp.vec2(v[0], v[1]))


@wp.func
def touches(x: wp.vec3, s: World, p: Params) -> bool:
    return x[2] <= s.geom_size[p.foot_geoms[0]][0]


@wp.func
def landed(seconds: float, p: Params) -> bool:
    """Whether a contact with this duration began in the last step."""
    return seconds > 0.0 and seconds < p.dt + 1e-6


@wp.func
def force(s: World, p: Params, leg: int) -> wp.vec3:
    k = p.forces + 3 * leg
    return wp.vec3(s.sensordata[k], s.sensordata[k + 1], s.sensordata[k + 2])


@wp.func
def substep(s: World, p: Params):
    for leg in range(int(4)):
        x, _ = foot(s, p, leg)
        touching = touches(x, s, p)
        s.contact_time[leg] = wp.where(touching, s.contact_time[leg] + p.substep_dt, 0.0)
        s.air_time[leg] = wp.where(touching, 0.0, s.air_time[leg] + p.substep_dt)


# the command


@wp.func
def stage(s: World, p: Params) -> int:  # of the curriculum
    k = int(0)
    for i in range(1, p.stages.shape[0]):
        if s.env_steps[0] >= p.stages[i, 0]:
            k = i
    return k


@wp.func
def command(s: World, p: Params) -> wp.vec3:
    """Commanded forward and lateral velocity, m/s, and yaw rate, rad/s, in the trunk's axes."""
    if s.standing[0] > 0.0:
        return wp.vec3(0.0)
    yaw_rate = s.drawn_velocity[2]
    if s.heading_controlled[0] > 0.0:
        error = s.heading_target[0] - heading(s)
        fastest = p.stages[stage(s, p), 3]
        yaw_rate = wp.clamp(p.heading_gain * wp.atan2(wp.sin(error), wp.cos(error)), -fastest, fastest)
    return wp.vec3(s.drawn_velocity[0], s.drawn_velocity[1], yaw_rate)


@wp.func
def amount(c: wp.vec3) -> float:  # magnitude of a command
    return wp.length(wp.vec2(c[0], c[1])) + wp.abs(c[2])


@wp.func
def active(c: wp.vec3, p: Params) -> float:  # 1 if the command is to move
    return wp.where(amount(c) > p.least_command, 1.0, 0.0)


@wp.func
def chosen(rng: Row[wp.uint32], share: float) -> bool:
    return lw.uniform(rng, 0.0, 1.0) < share


@wp.func
def draw_command(s: World, p: Params, rng: Row[wp.uint32]):
    k = stage(s, p)
    s.command_timer[0] = lw.uniform(rng, p.command_seconds[0], p.command_seconds[1])
    s.drawn_velocity[0] = lw.uniform(rng, p.stages[k, 1], p.stages[k, 2])
    s.drawn_velocity[1] = lw.uniform(rng, -p.lateral_velocity, p.lateral_velocity)
    s.drawn_velocity[2] = lw.uniform(rng, -p.stages[k, 3], p.stages[k, 3])
    s.heading_target[0] = lw.uniform(rng, -wp.pi, wp.pi)
    s.heading_controlled[0] = wp.where(chosen(rng, p.heading_share), 1.0, 0.0)
    s.standing[0] = wp.where(chosen(rng, p.standing_share), 1.0, 0.0)
    if chosen(rng, p.forward_share):
        s.drawn_velocity[0] = wp.max(wp.abs(s.drawn_velocity[0]), p.least_forward_velocity)
        s.drawn_velocity[1] = 0.0
        s.drawn_velocity[2] = 0.0


# actions and observations


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for j in range(12):
        scale = p.action_scale * s.actuator_forcerange[j][1] / s.actuator_gainprm[j][0]
        ctrl[j] = p.default_pose[j] + scale * action[j] - s.encoder_bias[j]


@wp.func
def put_robot(s: World, p: Params, obs: Row[float], bias: float) -> int:
    """Write the part that both groups share, with ``bias`` times the encoders' bias; returns the next index."""
    imu_velocity = linear_velocity(s) + wp.cross(angular_velocity(s), s.site_pos[p.imu])
    k = lw.put(obs, 0, imu_velocity)
    k = lw.put(obs, k, angular_velocity(s))
    k = lw.put(obs, k, gravity(s))
    for j in range(12):
        k = lw.put(obs, k, s.qpos[7 + j] + bias * s.encoder_bias[j] - p.default_pose[j])
    k = lw.put(obs, k, s.qvel, 6, 18)
    k = lw.put(obs, k, s.last_action)
    return lw.put(obs, k, command(s, p))


@wp.func
def add_noise(obs: Row[float], first: int, last: int, greatest: float, rng: Row[wp.uint32]):
    for i in range(first, last):
        obs[i] = obs[i] + lw.uniform(rng, -greatest, greatest)


@wp.func
def observe(s: World, p: Params, obs: Row[float], rng: Row[wp.uint32]):
    put_robot(s, p, obs, 1.0)
    add_noise(obs, 0, 3, p.linear_velocity_noise, rng)
    add_noise(obs, 3, 6, p.angular_velocity_noise, rng)
    add_noise(obs, 6, 9, p.gravity_noise, rng)
    add_noise(obs, 9, 21, p.joint_position_noise, rng)
    add_noise(obs, 21, 33, p.joint_velocity_noise, rng)


@wp.func
def observe_critic(s: World, p: Params, obs: Row[float]):
    k = put_robot(s, p, obs, 0.0)
    for leg in range(int(4)):
        x, _ = foot(s, p, leg)
        obs[k + leg] = height(x)
        obs[k + 4 + leg] = s.air_time[leg]
        obs[k + 8 + leg] = wp.where(touches(x, s, p), 1.0, 0.0)
        f = force(s, p, leg)
        for i in range(3):
            obs[k + 12 + 3 * leg + i] = wp.sign(f[i]) * wp.log(1.0 + wp.abs(f[i]))


# the terms of the reward; c is the command in the state before the step


@wp.func
def track_linear_velocity(c: wp.vec3, s1: World, p: Params) -> float:
    return wp.exp(-wp.length_sq(wp.vec3(c[0], c[1], 0.0) - linear_velocity(s1)) / p.linear_velocity_variance)


@wp.func
def track_angular_velocity(c: wp.vec3, s1: World, p: Params) -> float:
    return wp.exp(-wp.length_sq(wp.vec3(0.0, 0.0, c[2]) - angular_velocity(s1)) / p.angular_velocity_variance)


@wp.func
def upright(s1: World, p: Params) -> float:
    g = gravity(s1)
    return wp.exp(-wp.length_sq(wp.vec2(g[0], g[1])) / p.tilt_variance)


@wp.func
def pose(c: wp.vec3, s1: World, p: Params) -> float:
    std = p.walking_pose_std
    if amount(c) < p.least_command:
        std = p.standing_pose_std
    total = float(0.0)
    for j in range(12):
        error = (s1.qpos[7 + j] - p.default_pose[j]) / std[j % 3]
        total += error * error
    return wp.exp(-total / 12.0)


@wp.func
def dof_pos_limits(s1: World, p: Params) -> float:
    outside = float(0.0)
    for j in range(12):
        limits = s1.jnt_range[p.joints + j]
        middle, half = 0.5 * (limits[0] + limits[1]), 0.5 * (limits[1] - limits[0])
        outside += wp.max(wp.abs(s1.qpos[7 + j] - middle) - p.soft_limit * half, 0.0)
    return outside


@wp.func
def action_rate_l2(s0: World, action: Row[float]) -> float:
    total = float(0.0)
    for j in range(12):
        change = action[j] - s0.last_action[j]
        total += change * change
    return total


@wp.func
def foot_clearance_and_slip(c: wp.vec3, s1: World, p: Params) -> wp.vec2:
    """Both terms in one function, so that positions and velocities of the feet are computed once."""
    clearance, slip = float(0.0), float(0.0)
    for leg in range(int(4)):
        x, v = foot(s1, p, leg)
        clearance += wp.abs(height(x) - p.foot_height) * speed(v)
        if touches(x, s1, p):
            slip += speed(v) * speed(v)
    return wp.vec2(clearance * active(c, p), slip * active(c, p))


@wp.func
def foot_swing_height(c: wp.vec3, s0: World, s1: World, p: Params) -> float:
    total = float(0.0)
    for leg in range(int(4)):
        if landed(s1.contact_time[leg], p):
            error = s0.peak_height[leg] / p.foot_height - 1.0
            total += error * error
    return total * active(c, p)


@wp.func
def soft_landing(c: wp.vec3, s1: World, p: Params) -> float:
    total = float(0.0)
    for leg in range(int(4)):
        # the force is from the beginning of the last substep, when the contact was one substep younger
        if landed(s1.contact_time[leg] - p.substep_dt, p):
            total += wp.length(force(s1, p, leg))
    return total * active(c, p)


@wp.func
def terms(c: wp.vec3, s0: World, action: Row[float], s1: World, p: Params) -> lw.vec10:
    feet = foot_clearance_and_slip(c, s1, p)
    return p.dt * lw.vec10(
        p.track_linear_velocity * track_linear_velocity(c, s1, p),
        p.track_angular_velocity * track_angular_velocity(c, s1, p),
        p.upright * upright(s1, p),
        p.pose * pose(c, s1, p),
        p.dof_pos_limits * dof_pos_limits(s1, p),
        p.action_rate_l2 * action_rate_l2(s0, action),
        p.foot_clearance * feet[0],
        p.foot_swing_height * foot_swing_height(c, s0, s1, p),
        p.foot_slip * feet[1],
        p.soft_landing * soft_landing(c, s1, p),
    )


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.dot(terms(command(s0, p), s0, action, s1, p), lw.vec10(1.0))


@wp.func
def velocity_error(c: wp.vec3, s: World) -> float:
    v = linear_velocity(s)
    return wp.length(wp.vec2(c[0] - v[0], c[1] - v[1]))


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    c = command(s0, p)
    k = lw.put(metrics, 0, terms(c, s0, action, s1, p))
    k = lw.put(metrics, k, velocity_error(c, s1))
    lw.put(metrics, k, wp.abs(c[2] - angular_velocity(s1)[2]))


@wp.func
def evaluate(s: World, p: Params) -> float:  # velocity error, m/s
    return velocity_error(command(s, p), s)


@wp.func
def terminated(s: World, p: Params) -> bool:
    return wp.acos(wp.clamp(-gravity(s)[2], -1.0, 1.0)) > p.fall_angle


# between steps


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    for j in range(12):
        s1.last_action[j] = action[j]
    s1.command_timer[0] = s0.command_timer[0] - p.dt
    s1.push_timer[0] = s0.push_timer[0] - p.dt
    s1.env_steps[0] = s0.env_steps[0] + 1.0
    for leg in range(int(4)):
        peak = s0.peak_height[leg]
        x, _ = foot(s1, p, leg)
        if landed(s1.contact_time[leg], p):
            peak = 0.0
        elif not touches(x, s1, p):
            peak = wp.max(peak, height(x))
        s1.peak_height[leg] = peak


@wp.func
def push(s: World, p: Params, rng: Row[wp.uint32]):
    s.push_timer[0] = lw.uniform(rng, p.push_seconds[0], p.push_seconds[1])
    velocity = lw.uniform(rng, -p.push_velocity, p.push_velocity)
    spin = lw.quat_rotate_inverse(orientation(s), lw.uniform(rng, -p.push_spin, p.push_spin))
    for i in range(3):
        s.qvel[i] = s.qvel[i] + velocity[i]
        s.qvel[3 + i] = s.qvel[3 + i] + spin[i]


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    if s.command_timer[0] <= 0.0:
        draw_command(s, p, rng)
    if s.push_timer[0] < 1e-6:
        push(s, p, rng)


# robots and starts


@wp.func
def log_uniform(rng: Row[wp.uint32], bounds: wp.vec2) -> float:
    return wp.exp(lw.uniform(rng, wp.log(bounds[0]), wp.log(bounds[1])))


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    sliding = lw.uniform(rng, p.sliding_friction[0], p.sliding_friction[1])
    friction = wp.vec3(sliding, log_uniform(rng, p.spinning_friction), log_uniform(rng, p.rolling_friction))
    for leg in range(p.foot_geoms.shape[0]):
        s.geom_friction[p.foot_geoms[leg]] = friction
    s.body_ipos[p.trunk] = s.body_ipos[p.trunk] + lw.uniform(rng, -p.trunk_offset, p.trunk_offset)
    for j in range(12):
        s.encoder_bias[j] = lw.uniform(rng, -p.encoder_bias, p.encoder_bias)


@wp.func
def initialize(s: World, p: Params):
    k = lw.put_upright(s.qpos, 0, wp.vec3(0.0, 0.0, p.start_height), 0.0)
    for j in range(12):
        s.qpos[k + j] = p.default_pose[j]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    start = wp.vec3(s.qpos[0], s.qpos[1], s.qpos[2]) + lw.uniform(rng, p.start_low, p.start_high)
    lw.put_upright(s.qpos, 0, start, lw.uniform(rng, -p.start_yaw, p.start_yaw))
    s.push_timer[0] = lw.uniform(rng, p.push_seconds[0], p.push_seconds[1])
    draw_command(s, p, rng)


ROBOT = {
    "linear_velocity": 3,
    "angular_velocity": 3,
    "gravity": 3,
    "joint_position": 12,
    "joint_velocity": 12,
    "last_action": 12,
    "command": 3,
}
FEET = {"foot_height": 4, "foot_air_time": 4, "foot_contact": 4, "foot_force": 12}


@lw.register
class Go1Velocity(lw.Task):
    model, frame_skip, horizon = "go1.xml", 4, 1000
    actions = {"joint_position": 12}
    obs = {"policy": ROBOT, "critic": ROBOT | FEET}
    metrics = (
        "track_linear_velocity",
        "track_angular_velocity",
        "upright",
        "pose",
        "dof_pos_limits",
        "action_rate_l2",
        "foot_clearance",
        "foot_swing_height",
        "foot_slip",
        "soft_landing",
        "velocity_error",
        "yaw_rate_error",
    )
    cleared = ("sensordata",)  # zero before the first substep; mjlab computes it for the first state
