"""Define velocity tasks for walking robots, which follow commanded velocities and yaw rates on flat ground.

Actions are offsets of the joints' servo targets from the default pose. Each robot's file lists the model, the actuated
joints and the feet, and sets parameters. Observations, rewards, commands, pushes and resets are taken from mjlab
1.6.0's velocity tasks.

The base is the body of the model's first joint, a free joint. Functions read the state after the last substep. The
forces on the feet are an exception: MuJoCo computes them at the start of that substep. At the start of an episode,
these forces are 0. Positions and velocities of the feet are computed from the joints, which saves a forward pass. A
foot is in contact if a sphere of its sole (``soles``) reaches the ground. Only ``ground`` and ``distance`` depend on
the shape of the ground.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms, walkers
from lyceum_warp.tasks.velocity import gates

# terms and arguments
from lyceum_warp.terms import (  # noqa: F401
    action_rate_l2,
    active,
    angular_velocity,
    base_height,
    fell_over,
    foot_swing_height,
    gravity,
    linear_velocity,
    pose,
    roll_pitch_rate_l2,
    soft_landing,
    too_low,
    track_angular_velocity,
    track_linear_velocity,
    upright,
    velocity_error,
    yaw_rate_error,
)


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    sensordata: Row[float]  # forces on the feet in the world's axes, N
    body_ipos: Row[wp.vec3]
    jnt_range: Row[wp.vec2]
    geom_friction: Row[wp.vec3]
    drawn_velocity: Row[wp.vec3] = lw.memory()  # random forward velocity, lateral velocity and yaw rate
    heading_target: Row[float] = lw.memory()  # commanded heading, rad
    heading_controlled: Row[float] = lw.memory()  # 1 if the yaw rate follows the heading
    standing: Row[float] = lw.memory()  # 1 if the robot should stand
    command_timer: Row[float] = lw.memory()  # seconds until the next command
    push_timer: Row[float] = lw.memory()  # seconds until a push
    last_action: Row[float] = lw.memory("joints")
    previous_action: Row[float] = lw.memory("joints")
    contact_time: Row[float] = lw.memory("feet")  # seconds of each foot's contact; 0 in the air
    air_time: Row[float] = lw.memory("feet")  # seconds of each foot's swing; 0 in contact
    swing_height: Row[float] = lw.memory("feet")  # greatest height in each foot's last swing, m
    encoder_bias: Row[float] = lw.lasting_memory("joints")  # rad
    peak_height: Row[float] = lw.lasting_memory("feet")  # greatest height since each foot's last landing, m
    env_steps: Row[float] = lw.lasting_memory()


@wp.struct
class Params:
    dt: float  # seconds in a step
    substep_dt: float  # seconds in a substep
    # the robot
    joints: wp.array[int] = lw.joints()  # the actuated joints, in the order of actions and observations
    feet: wp.array[int] = lw.sites()  # a site at each foot
    trunk: int = lw.from_model(walkers.base)  # the body of the free joint
    imu: wp.vec3 = wp.vec3(0.0)  # the velocimeter's position on the base, m
    joint_qpos: wp.array[int] = lw.from_model(walkers.joint_qpos)  # indices of the joints in qpos
    joint_dof: wp.array[int] = lw.from_model(walkers.joint_dof)  # indices of the joints in qvel
    controls: wp.array[int] = lw.from_model(walkers.controls)  # indices of the joints' servos in ctrl
    leg_qpos: wp.array2d[int] = lw.from_model(walkers.leg_qpos)  # indices of each leg's joints in qpos; -1 for none
    leg_dof: wp.array2d[int] = lw.from_model(walkers.leg_dof)  # indices of each leg's joints in qvel; -1 for none
    leg_axes: wp.array2d[wp.vec3] = lw.from_model(walkers.leg_axes)  # axes of each leg's joints
    leg_offsets: wp.array2d[wp.vec3] = lw.from_model(walkers.leg_offsets)  # from each leg's joint to the next, m
    foot_offsets: wp.array[wp.vec3] = lw.from_model(walkers.foot_offsets)  # from the last joint to the foot, m
    foot_geoms: wp.array[int] = lw.from_model(walkers.foot_geoms)  # geoms of the feet that can touch the ground
    foot_forces: wp.array[int] = lw.from_model(walkers.foot_forces)  # indices of the forces in sensordata
    soles: wp.array2d[wp.vec4] = lw.from_model(walkers.soles)  # spheres of each foot: centre and radius, m
    # reward terms
    linear_velocity_variance: float = 0.25  # squared error at which the term is 1/e, (m/s)^2
    angular_velocity_variance: float = 0.5  # squared error at which the term is 1/e, (rad/s)^2
    tilt_variance: float = 0.2  # squared sine of the tilt at which the term upright is 1/e
    standing_pose_std: wp.array[float] = lw.from_model(lambda model, p: len(p.joints) * [0.05])  # for pose, rad
    walking_pose_std: wp.array[float] = lw.from_model(lambda model, p: len(p.joints) * [0.3])  # for pose, rad
    soft_limit: float = 0.9  # fraction of a joint's range that has no cost
    swing_target: float = 0.1  # desired height of a foot in its swing, m
    longest_step: float = 0.4  # longest rewarded single stance, s
    least_command: float = 0.05  # if the size of a command is below this number, the robot should stand
    fall_angle: float = math.radians(70.0)  # tilt that ends an episode, rad
    least_height: float = 0.0  # of the base; an episode ends below it, m
    # actions
    default_pose: wp.array[float] = lw.from_model(walkers.home_pose)  # the servos' targets under the action 0, rad
    action_scale: wp.array[float] = lw.from_model(walkers.quarter_of_force)  # rad for an action of 1
    # commands
    stages: wp.array2d[float] = [
        [0.0, -1.0, 1.0, 0.5],
        [120e3, -1.5, 2.0, 0.7],
        [240e3, -2.0, 3.0, 0.7],
    ]  # first step, least and greatest forward velocity (m/s) and greatest yaw rate (rad/s) of each stage
    lateral_velocity: float = 1.0  # greatest, m/s
    command_seconds: wp.vec2 = wp.vec2(3.0, 8.0)  # range of a command's duration, s
    heading_share: float = 0.3  # fraction of commands that give a heading
    heading_gain: float = 0.5  # yaw rate per error of the heading, 1/s
    standing_share: float = 0.1  # fraction of commands to stand
    forward_share: float = 0.2  # fraction of commands to walk straight ahead
    least_forward_velocity: float = 0.3  # of commands to walk straight ahead, m/s
    # noise on the policy's observations
    linear_velocity_noise: float = 0.5  # bound of the uniform noise, m/s
    angular_velocity_noise: float = 0.2  # bound of the uniform noise, rad/s
    gravity_noise: float = 0.05  # bound of the uniform noise on the direction of gravity
    joint_position_noise: float = 0.01  # bound of the uniform noise, rad
    joint_velocity_noise: float = 1.5  # bound of the uniform noise, rad/s
    # pushes
    push_seconds: wp.vec2 = wp.vec2(1.0, 3.0)  # range of the time between two pushes, s
    push_velocity: wp.vec3 = wp.vec3(0.5, 0.5, 0.4)  # largest change of velocity, in the world's axes, m/s
    push_spin: wp.vec3 = wp.vec3(0.52, 0.52, 0.78)  # largest change of angular velocity, in the world's axes, rad/s
    # differences between robots
    encoder_bias: float = 0.015  # largest, rad
    trunk_offset: wp.vec3 = wp.vec3(0.025, 0.025, 0.03)  # largest shift of the centre of mass, m
    sliding_friction: wp.vec2 = wp.vec2(0.3, 1.5)  # range of the feet's friction, uniform
    spinning_friction: wp.vec2 = wp.vec2(1e-4, 2e-2)  # range of the feet's friction, log-uniform
    rolling_friction: wp.vec2 = wp.vec2(1e-5, 5e-3)  # range of the feet's friction, log-uniform
    # resets
    start_height: float = lw.from_model(walkers.home_height)  # of the base, m
    start_low: wp.vec3 = wp.vec3(-0.5, -0.5, 0.01)  # least offset of the base, m
    start_high: wp.vec3 = wp.vec3(0.5, 0.5, 0.05)  # greatest offset of the base, m
    start_yaw: float = 3.14  # largest, rad


@wp.struct
class Policy:
    linear_velocity: Row[wp.vec3] = lw.part()  # at the velocimeter
    angular_velocity: Row[wp.vec3] = lw.part()
    gravity: Row[wp.vec3] = lw.part()
    joint_position: Row[float] = lw.part("joints")
    joint_velocity: Row[float] = lw.part("joints")
    last_action: Row[float] = lw.part("joints")
    command: Row[wp.vec3] = lw.part()


@wp.struct
class Critic(Policy):
    foot_height: Row[float] = lw.part("feet")
    foot_air_time: Row[float] = lw.part("feet")
    foot_contact: Row[float] = lw.part("feet")
    foot_force: Row[wp.vec3] = lw.part("feet")  # sign(f) log(1 + |f|)


# the feet


@wp.func
def ground(x: wp.vec3, s: World, p: Params) -> float:
    """Return the height of the ground below a point in the world."""
    return 0.0


@wp.func
def distance(x: wp.vec3, s: World, p: Params) -> float:
    """Return the distance of a point in the world from the ground."""
    return x[2] - ground(x, s, p)


@wp.func
def last_joint(s: World, p: Params, foot: int) -> tuple[wp.vec3, lw.quat, wp.vec3, wp.vec3]:
    """Return position, rotation, velocity and angular velocity of the last joint in the leg of a foot."""
    turn = terms.orientation(s.qpos)
    x, v = wp.vec3(s.qpos[0], s.qpos[1], s.qpos[2]), wp.vec3(s.qvel[0], s.qvel[1], s.qvel[2])
    w = lw.quat_rotate(turn, terms.angular_velocity(s.qvel))
    for k in range(p.leg_qpos.shape[1]):
        if p.leg_qpos[foot, k] >= 0:
            step = lw.quat_rotate(turn, p.leg_offsets[foot, k])
            x += step
            v += wp.cross(w, step)
            w += s.qvel[p.leg_dof[foot, k]] * lw.quat_rotate(turn, p.leg_axes[foot, k])
            turn = lw.quat_mul(turn, lw.quat_from_axis_angle(p.leg_axes[foot, k], s.qpos[p.leg_qpos[foot, k]]))
    return x, turn, v, w


@wp.func
def foot_motion(s: World, p: Params, foot: int) -> tuple[wp.vec3, wp.vec3]:
    """Return the position and the velocity of a foot's site in the world."""
    x, turn, v, w = last_joint(s, p, foot)
    step = lw.quat_rotate(turn, p.foot_offsets[foot])
    return x + step, v + wp.cross(w, step)


@wp.func
def height(x: wp.vec3, s: World, p: Params) -> float:  # clipped at 1 m, the range of mjlab's rays
    return wp.clamp(x[2] - ground(x, s, p), 0.0, 1.0)


@wp.func
def sole_touches(x: wp.vec3, turn: lw.quat, s: World, p: Params, foot: int) -> bool:
    """Return whether a foot touches the ground, from the position and the rotation of the last joint in its leg."""
    touching = bool(False)
    for i in range(p.soles.shape[1]):
        sphere = p.soles[foot, i]
        centre = x + lw.quat_rotate(turn, wp.vec3(sphere[0], sphere[1], sphere[2]))
        if distance(centre, s, p) <= sphere[3]:
            touching = True
    return touching


@wp.func
def substep(s: World, p: Params):
    for foot in range(p.feet.shape[0]):
        x, turn, _, _ = last_joint(s, p, foot)
        terms.run_clocks(foot, sole_touches(x, turn, s, p, foot), s.contact_time, s.air_time, p.substep_dt)


# the command


@wp.func
def stage(s: World, p: Params) -> int:  # of the curriculum
    k = int(0)
    for i in range(1, p.stages.shape[0]):
        if s.env_steps[0] >= p.stages[i, 0]:
            k = i
    return k


@wp.func
def command(s0: World, p: Params) -> wp.vec3:
    """Return the commanded forward velocity (m/s), lateral velocity (m/s) and yaw rate (rad/s), in the base's axes."""
    return terms.velocity_command(
        s0.drawn_velocity, s0.heading_target, s0.heading_controlled, s0.standing, terms.heading(s0.qpos),
        p.heading_gain, p.stages[stage(s0, p), 3],
    )  # fmt: skip


@wp.func
def draw_command(s: World, p: Params, rng: Row[wp.uint32]):
    k = stage(s, p)
    terms.draw_timer(s.command_timer, p.command_seconds, rng)
    low = wp.vec3(p.stages[k, 1], -p.lateral_velocity, -p.stages[k, 3])
    terms.draw_velocity(s.drawn_velocity, low, wp.vec3(p.stages[k, 2], -low[1], -low[2]), rng)
    terms.draw_heading(s.heading_target, s.heading_controlled, p.heading_share, rng)
    terms.draw_flag(s.standing, p.standing_share, rng)
    terms.draw_forward_only(s.drawn_velocity, p.forward_share, p.least_forward_velocity, rng)


# actions and observations


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for j in range(p.joints.shape[0]):
        ctrl[p.controls[j]] = p.default_pose[j] + p.action_scale[j] * action[j] - s.encoder_bias[j]


@wp.func
def observe_robot(s: World, p: Params, obs: Any):
    """Write the observations that policy and critic share, except the joint positions."""
    obs.angular_velocity[0] = terms.angular_velocity(s.qvel)
    obs.linear_velocity[0] = terms.linear_velocity(s.qpos, s.qvel) + wp.cross(obs.angular_velocity[0], p.imu)
    obs.gravity[0] = terms.gravity(s.qpos)
    terms.gather(obs.joint_velocity, s.qvel, p.joint_dof)
    lw.put(obs.last_action, 0, s.last_action)
    obs.command[0] = command(s, p)


@wp.func
def observe(s: World, p: Params, obs: Policy, rng: Row[wp.uint32]):
    observe_robot(s, p, obs)
    terms.gather_positions(obs.joint_position, s.qpos, p.joint_qpos, p.default_pose, s.encoder_bias)
    terms.add_uniform_noise(obs.linear_velocity, p.linear_velocity_noise, rng)
    terms.add_uniform_noise(obs.angular_velocity, p.angular_velocity_noise, rng)
    terms.add_uniform_noise(obs.gravity, p.gravity_noise, rng)
    terms.add_uniform_noise(obs.joint_position, p.joint_position_noise, rng)
    terms.add_uniform_noise(obs.joint_velocity, p.joint_velocity_noise, rng)


@wp.func
def observe_critic(s: World, p: Params, obs: Critic):
    observe_robot(s, p, obs)
    terms.gather_positions(obs.joint_position, s.qpos, p.joint_qpos, p.default_pose)
    for foot in range(p.feet.shape[0]):
        x, turn, _, _ = last_joint(s, p, foot)
        obs.foot_height[foot] = height(x + lw.quat_rotate(turn, p.foot_offsets[foot]), s, p)
        obs.foot_air_time[foot] = s.air_time[foot]
        obs.foot_contact[foot] = wp.where(sole_touches(x, turn, s, p, foot), 1.0, 0.0)
        f = terms.sensor_vector(s.sensordata, p.foot_forces[foot])
        for i in range(3):
            f[i] = wp.sign(f[i]) * wp.log(1.0 + wp.abs(f[i]))
        obs.foot_force[foot] = f


# between steps


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    lw.put(s1.previous_action, 0, s0.last_action)
    lw.put(s1.last_action, 0, action)
    terms.run_timer(s1.command_timer, p.dt)
    terms.run_timer(s1.push_timer, p.dt)
    s1.env_steps[0] = s1.env_steps[0] + 1.0
    for foot in range(p.feet.shape[0]):
        x, _ = foot_motion(s1, p, foot)
        terms.follow_swing(foot, height(x, s1, p), s1.contact_time, s1.peak_height, s1.swing_height, p.dt)


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    if terms.is_due(s.command_timer):
        draw_command(s, p, rng)
    if terms.is_due(s.push_timer):
        terms.draw_timer(s.push_timer, p.push_seconds, rng)
        terms.push(s.qpos, s.qvel, p.push_velocity, p.push_spin, rng)


# robots and starts


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    terms.draw_friction(s.geom_friction, p.foot_geoms, p.sliding_friction, p.spinning_friction, p.rolling_friction, rng)
    terms.shift_center_of_mass(s.body_ipos, p.trunk, p.trunk_offset, rng)
    terms.draw_row(s.encoder_bias, -p.encoder_bias, p.encoder_bias, rng)


@wp.func
def initialize(s: World, p: Params):
    lw.put_upright(s.qpos, 0, wp.vec3(0.0, 0.0, p.start_height), 0.0)
    for j in range(p.joints.shape[0]):
        s.qpos[p.joint_qpos[j]] = p.default_pose[j]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    start = wp.vec3(s.qpos[0], s.qpos[1], s.qpos[2]) + lw.uniform(rng, p.start_low, p.start_high)
    lw.put_upright(s.qpos, 0, start, lw.uniform(rng, -p.start_yaw, p.start_yaw))
    terms.draw_timer(s.push_timer, p.push_seconds, rng)
    draw_command(s, p, rng)


# these functions read the command before the step


@wp.func
def foot_clearance_and_slip(active: float, s: World, p: Params) -> wp.vec2:
    """Return the terms foot_clearance and foot_slip together, so that the motion of the feet is computed only once."""
    clearance, slip = float(0.0), float(0.0)
    for foot in range(p.feet.shape[0]):
        x, v = foot_motion(s, p, foot)
        clearance += terms.clearance(height(x, s, p), v, p.swing_target)
        if s.contact_time[foot] > 0.0:
            slip += terms.ground_speed(v) * terms.ground_speed(v)
    return wp.vec2(clearance * active, slip * active)


@wp.func
def foot_clearance(foot_clearance_and_slip: wp.vec2) -> float:
    return foot_clearance_and_slip[0]


@wp.func
def foot_slip(foot_clearance_and_slip: wp.vec2) -> float:
    return foot_clearance_and_slip[1]


@wp.func
def single_stance(contact_time: Row[float], air_time: Row[float], longest_step: float, active: float) -> float:
    """Reward standing on one foot: min(its contact time, the air time of the other feet, ``longest_step``), s.

    The result is 0 unless exactly one foot is in contact. Source: Isaac Lab, ``feet_air_time_positive_biped``.
    """
    down, least = int(0), float(longest_step)
    for foot in range(contact_time.shape[0]):
        if contact_time[foot] > 0.0:
            down += 1
        least = wp.min(least, wp.max(contact_time[foot], air_time[foot]))
    return wp.where(down == 1, active * least, 0.0)


dof_pos_limits = terms.joint_limits


@wp.func
def evaluate(s: World, p: Params) -> float:  # velocity error, m/s
    return terms.velocity_error(command(s, p), terms.linear_velocity(s.qpos, s.qvel))


def playground_model_edit(feet: Sequence[str]) -> Any:
    """Return ``edit_model`` for a robot of MuJoCo Playground: add force sensors, and ignore the ground's friction."""
    return staticmethod(partial(walkers.prepare_walker, feet=feet, timestep=0.004, iterations=(3, 5)))


class Velocity(lw.Task):
    """A legged robot that follows velocity commands."""

    frame_skip, horizon = 4, 1000
    gate = gates.Walks()
    physics = {"coarse": lw.PhysicsOptions(integrator="discrete", frame_skip=1, timestep=0.02)}
    training = lw.Training(algorithm="ppo", iterations=400, physics="coarse")
    actions = {"joint_position": "joints"}
    rewards = {
        "track_linear_velocity": 2.0,
        "track_angular_velocity": 2.0,
        "upright": 1.0,
        "pose": 1.0,
        "dof_pos_limits": -1.0,
        "action_rate_l2": -0.1,
        "foot_clearance": -2.0,
        "foot_swing_height": -0.25,
        "foot_slip": -0.1,
        "soft_landing": -1e-5,
    }
    metrics = ("velocity_error", "yaw_rate_error")
    terminations = ("fell_over", "too_low")
    deployment, mirror = staticmethod(walkers.deployment), staticmethod(walkers.mirror)
    cleared = ("sensordata",)  # a reset clears the forces; mjlab computes them for the first state


@wp.struct
class BipedParams(Params):
    stages: wp.array2d[float] = [[0.0, -1.0, 1.0, 1.0]]  # gates.Walks asks for up to 1 m/s backwards
    lateral_velocity: float = 0.6
    push_seconds: wp.vec2 = wp.vec2(5.0, 10.0)
    fall_angle: float = math.acos(0.6)


class Biped(Velocity):
    """A robot with two legs that follows velocity commands.

    One additional term rewards single stance, and another penalizes roll and pitch rates.
    """

    frame_skip, keyframe = 5, "home"
    training = lw.Training(algorithm="ppo", settings={"log_std": -0.7}, iterations=800, physics="coarse")
    rewards = Velocity.rewards | {"action_rate_l2": -0.05, "single_stance": 2.0, "roll_pitch_rate_l2": -0.05}
