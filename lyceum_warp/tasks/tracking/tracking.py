"""Define motion tracking for robots with a floating base: follow a clip in space and time.

The task is mjlab 1.6.0's, which reimplements BeyondMimic (Liao et al. 2025, "BeyondMimic: from motion tracking to
versatile humanoid control via guided diffusion"). The anchor is the body to which positions and orientations are
relative. A *relative* pose is that of the reference, turned about the vertical and moved horizontally so that the
anchors agree. Errors are squared and averaged over the tracked bodies.

All clips lie in one table. Each world's memory says which clip and which row of the table it should be at. The policy
observes the row that follows, and is rewarded for reaching it.

Episodes begin anywhere in the clips. Clips are divided into bins. The more episodes fail in a bin, the more episodes
begin there. All worlds share the counts of failures, also those of several processes.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, clip_tables, terms, walkers
from lyceum_warp.tasks.tracking import gates
from lyceum_warp.terms import joint_limits  # noqa: F401


@wp.struct
class Shared:
    episodes: Row[float] = lw.part()  # recent episodes
    failures: Row[float] = lw.part("bins")  # failures of recent episodes in each bin
    starts: Row[float] = lw.part("bins")  # probability that an episode begins in this bin or in an earlier one


@wp.struct
class Sums:
    episodes: Row[float] = lw.part()
    failures: Row[float] = lw.part("bins")


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    xpos: Row[wp.vec3]
    xquat: Row[lw.quat]
    cvel: Row[wp.spatial_vector]
    subtree_com: Row[wp.vec3]
    sensordata: Row[float]  # the largest force between parts of the robot, N
    body_ipos: Row[wp.vec3]
    jnt_range: Row[wp.vec2]
    geom_friction: Row[wp.vec3]
    clip: Row[float] = lw.memory()
    frame: Row[float] = lw.memory()  # row of the tables that the world should be at
    collision_time: Row[float] = lw.memory()  # seconds of contact between parts of the robot in the episode so far
    push_timer: Row[float] = lw.memory()  # seconds until a push
    last_action: Row[float] = lw.memory("joints")
    encoder_bias: Row[float] = lw.lasting_memory("joints")  # rad
    shared: Shared


@wp.struct
class Params:
    dt: float  # seconds in a step
    substep_dt: float  # seconds in a substep
    # the robot
    joints: wp.array[int] = lw.joints()  # the actuated joints, in the order of actions and observations
    bodies: wp.array[int] = lw.bodies()  # the tracked bodies: first the anchor, then the end effectors, then others
    ends: int = 4  # number of end effectors
    feet: wp.array[int] = lw.sites()  # a site at each foot
    imu: wp.vec3 = wp.vec3(0.0)  # the velocimeter's position on the base, m
    base: int = lw.from_model(walkers.base)  # the body of the free joint
    joint_qpos: wp.array[int] = lw.from_model(walkers.joint_qpos)  # indices of the joints in qpos
    joint_dof: wp.array[int] = lw.from_model(walkers.joint_dof)  # indices of the joints in qvel
    controls: wp.array[int] = lw.from_model(walkers.controls)  # indices of the joints' servos in ctrl
    default_pose: wp.array[float] = lw.from_model(walkers.home_pose)  # the servos' targets under the action 0, rad
    reference_share: float = 0.0  # with 1, the targets under the action 0 are those of the reference instead
    action_scale: wp.array[float] = lw.from_model(walkers.quarter_of_force)  # rad for an action of 1
    foot_geoms: wp.array[int] = lw.from_model(walkers.foot_geoms)  # geoms of the feet that can touch the ground
    self_contact: int = lw.sensor("self_contact")  # index of the force in sensordata
    # clips
    clips: wp.array2d[float] = lw.from_model(clip_tables.standing)  # lw.load_clips: time, weight and coordinates
    ranges: wp.array2d[int] = lw.from_model(clip_tables.ranges)  # first row and number of rows of each clip
    reference_qvel: wp.array2d[float] = lw.from_model(clip_tables.reference("qvel"))  # of each row
    reference_position: wp.array2d[wp.vec3] = lw.from_model(clip_tables.reference("positions"))  # of the bodies, m
    reference_rotation: wp.array2d[lw.quat] = lw.from_model(clip_tables.reference("rotations"))  # of the bodies
    reference_velocity: wp.array2d[wp.vec3] = lw.from_model(clip_tables.reference("velocities"))  # of the bodies, m/s
    reference_spin: wp.array2d[wp.vec3] = lw.from_model(clip_tables.reference("spins"))  # of the bodies, rad/s
    start_clip: int = -1  # the clip of new episodes; -1 draws one
    start_frame: int = -1  # the frame of the clip at which new episodes begin; -1 draws one
    # where episodes begin
    bin_seconds: float = 1.0  # length of a bin; longer if there would be more than 2,048, s
    bins: wp.array2d[int] = lw.from_model(clip_tables.bins)  # clip, first row and number of rows of each bin
    bin_ends: wp.array[int] = lw.from_model(clip_tables.bin_ends)  # last row that belongs to each bin
    bin_starts: wp.array[float] = lw.from_model(clip_tables.bin_starts)  # as Shared.starts, without failures
    failure_weight: float = 1.0  # weight of failures per episode; 0 for uniform starts
    uniform_weight: float = 0.01  # weight of uniform starts
    forgetting: float = 0.024  # fraction of old failures that an update forgets; mjlab's 0.001 per step, for 24 steps
    earlier_bins: int = 1  # number of bins, up to the one of a failure, that a failure counts for
    earlier_decay: float = 0.8  # ratio of the counts of successive bins
    # reward terms: the errors at which a term is 1/e
    anchor_position_std: float = 0.3  # m
    anchor_rotation_std: float = 0.4  # rad
    body_position_std: float = 0.3  # m
    body_rotation_std: float = 0.4  # rad
    body_velocity_std: float = 1.0  # m/s
    body_spin_std: float = 3.14  # rad/s
    soft_limit: float = 0.9  # fraction of a joint's range that has no cost
    contact_force: float = 10.0  # contacts between parts of the robot count above this force, N
    # ends of episodes
    height_limit: float = 0.25  # largest error of the anchor's and the end effectors' heights, m
    tilt_limit: float = 0.8  # largest error of the vertical component of gravity in the anchor's axes
    # random numbers
    randomness: float = 1.0  # factor of all that follows: noise, pushes, differences between robots and of starts
    position_noise: float = 0.25  # bound of the uniform noise on the anchor's position, m
    rotation_noise: float = 0.05  # bound of the uniform noise on the anchor's axes
    linear_velocity_noise: float = 0.5  # bound of the uniform noise, m/s
    angular_velocity_noise: float = 0.2  # bound of the uniform noise, rad/s
    joint_position_noise: float = 0.01  # bound of the uniform noise, rad
    joint_velocity_noise: float = 0.5  # bound of the uniform noise, rad/s
    push_seconds: wp.vec2 = wp.vec2(1.0, 3.0)  # range of the time between two pushes, s
    push_velocity: wp.vec3 = wp.vec3(0.5, 0.5, 0.2)  # largest change of velocity, in the world's axes, m/s
    push_spin: wp.vec3 = wp.vec3(0.52, 0.52, 0.78)  # largest change of angular velocity, in the world's axes, rad/s
    encoder_bias: float = 0.01  # largest, rad
    anchor_offset: wp.vec3 = wp.vec3(0.025, 0.05, 0.05)  # largest shift of the anchor's centre of mass, m
    friction: wp.vec2 = wp.vec2(0.3, 1.2)  # range of the feet's sliding friction
    start_position: wp.vec3 = wp.vec3(0.05, 0.05, 0.01)  # largest offset of the base, m
    start_rotation: wp.vec3 = wp.vec3(0.1, 0.1, 0.2)  # largest roll, pitch and yaw, rad
    start_joint: float = 0.1  # largest offset of a joint, rad


# the reference


@wp.func
def last_row(s: World, p: Params) -> int:
    """Return the last row of the world's clip."""
    clip = int(s.clip[0])
    return p.ranges[clip, 0] + p.ranges[clip, 1] - 1


@wp.func
def next_row(s: World, p: Params) -> int:
    """Return the row that the policy should reach with its next action."""
    return wp.min(int(s.frame[0]) + 1, last_row(s, p))


@wp.func
def yaw_between(a: lw.quat, b: lw.quat) -> lw.quat:
    """Return the rotation about the vertical that is nearest to the rotation from b to a."""
    q = lw.quat_mul(a, lw.quat_inverse(b))
    yaw = wp.atan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] * q[2] + q[3] * q[3]))
    return lw.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw)


@wp.func
def down(q: lw.quat) -> float:
    """Return the vertical component of the direction of gravity in the axes of a frame."""
    return lw.quat_rotate_inverse(q, wp.vec3(0.0, 0.0, -1.0))[2]


@wp.struct
class Errors:
    position: float  # mean squared error of relative positions, m^2
    rotation: float  # of relative rotations, rad^2
    velocity: float  # of velocities in the world's axes, (m/s)^2
    spin: float  # of angular velocities in the world's axes, (rad/s)^2
    global_distance: float  # mean error of positions in the world, m
    distance: float  # mean error of relative positions, m
    end_distance: float  # of the end effectors, m
    end_angle: float  # mean error of the end effectors' relative rotations, rad
    end_height: float  # largest error of the end effectors' heights, m


@wp.func
def errors(s: World, p: Params) -> Errors:
    """Compare the tracked bodies with the reference, all in one pass."""
    e = Errors()
    row, anchor = int(s.frame[0]), p.bodies[0]
    n, ends = float(p.bodies.shape[0]), float(p.ends)
    turn = yaw_between(s.xquat[anchor], p.reference_rotation[row, 0])
    place = wp.vec3(s.xpos[anchor][0], s.xpos[anchor][1], p.reference_position[row, 0][2])
    for i in range(p.bodies.shape[0]):
        body = p.bodies[i]
        x, reference = s.xpos[body], p.reference_position[row, i]
        off = wp.length(place + lw.quat_rotate(turn, reference - p.reference_position[row, 0]) - x)
        angle = lw.quat_angle(lw.quat_mul(turn, p.reference_rotation[row, i]), s.xquat[body])
        v = lw.body_velocity(s.cvel[body], s.subtree_com[p.base], x)
        e.position += off * off / n
        e.rotation += angle * angle / n
        e.velocity += wp.length_sq(p.reference_velocity[row, i] - wp.spatial_bottom(v)) / n
        e.spin += wp.length_sq(p.reference_spin[row, i] - wp.spatial_top(v)) / n
        e.global_distance += wp.length(reference - x) / n
        e.distance += off / n
        if i > 0 and i <= p.ends:
            e.end_distance += off / ends
            e.end_angle += angle / ends
            e.end_height = wp.max(e.end_height, wp.abs(reference[2] - x[2]))
    return e


# rewards


@wp.func
def anchor_position(s: World, p: Params) -> float:
    error = wp.length(p.reference_position[int(s.frame[0]), 0] - s.xpos[p.bodies[0]]) / p.anchor_position_std
    return wp.exp(-error * error)


@wp.func
def anchor_rotation(s: World, p: Params) -> float:
    angle = lw.quat_angle(p.reference_rotation[int(s.frame[0]), 0], s.xquat[p.bodies[0]]) / p.anchor_rotation_std
    return wp.exp(-angle * angle)


@wp.func
def body_position(errors: Errors, body_position_std: float) -> float:
    return wp.exp(-errors.position / (body_position_std * body_position_std))


@wp.func
def body_rotation(errors: Errors, body_rotation_std: float) -> float:
    return wp.exp(-errors.rotation / (body_rotation_std * body_rotation_std))


@wp.func
def body_velocity(errors: Errors, body_velocity_std: float) -> float:
    return wp.exp(-errors.velocity / (body_velocity_std * body_velocity_std))


@wp.func
def body_spin(errors: Errors, body_spin_std: float) -> float:
    return wp.exp(-errors.spin / (body_spin_std * body_spin_std))


@wp.func
def action_rate_l2(s0: World, action: Row[float]) -> float:
    return terms.action_rate_l2(action, s0.last_action)


@wp.func
def self_collision(s0: World, s1: World) -> float:
    """Count the substeps of mjlab, 5 ms, with contact between parts of the robot."""
    return (s1.collision_time[0] - s0.collision_time[0]) / 0.005


# metrics


@wp.func
def mpkpe(errors: Errors) -> float:  # mean error of the tracked bodies' positions in the world, m
    return errors.global_distance


@wp.func
def r_mpkpe(errors: Errors) -> float:  # the same for relative positions, m
    return errors.distance


@wp.func
def end_position_error(errors: Errors) -> float:  # of relative positions, m
    return errors.end_distance


@wp.func
def end_rotation_error(errors: Errors) -> float:  # of relative rotations, rad
    return errors.end_angle


@wp.func
def joint_error(values: Row[float], reference: Row[float], at: wp.array[int]) -> float:
    """Return the root mean square of the differences over the joints."""
    total = float(0.0)
    for j in range(at.shape[0]):
        error = values[at[j]] - reference[at[j]]
        total += error * error
    return wp.sqrt(total / float(at.shape[0]))


@wp.func
def joint_position_error(s: World, p: Params) -> float:  # rad
    return joint_error(s.qpos, p.clips[int(s.frame[0]), 2:], p.joint_qpos)


@wp.func
def joint_velocity_error(s: World, p: Params) -> float:  # rad/s
    return joint_error(s.qvel, p.reference_qvel[int(s.frame[0])], p.joint_dof)


@wp.func
def base_height_error(s: World, p: Params) -> float:  # m
    return wp.abs(s.qpos[2] - p.clips[int(s.frame[0]), 4])


@wp.func
def base_tilt_error(s: World, p: Params) -> float:  # of the vertical component of gravity in the base's axes
    return wp.abs(down(terms.orientation(p.clips[int(s.frame[0]), 2:])) - down(terms.orientation(s.qpos)))


# ends


@wp.func
def anchor_height(s: World, p: Params) -> bool:
    return wp.abs(p.reference_position[int(s.frame[0]), 0][2] - s.xpos[p.bodies[0]][2]) > p.height_limit


@wp.func
def anchor_tilt(s: World, p: Params) -> bool:
    return wp.abs(down(p.reference_rotation[int(s.frame[0]), 0]) - down(s.xquat[p.bodies[0]])) > p.tilt_limit


@wp.func
def end_height(errors: Errors, height_limit: float) -> bool:
    return errors.end_height > height_limit


@wp.func
def clip_end(s: World, p: Params) -> bool:
    return int(s.frame[0]) >= last_row(s, p)


# actions and observations


@wp.struct
class Blind:
    """What a robot observes without an estimate of its position and velocity."""

    reference_joint_position: Row[float] = lw.part("joints")
    reference_joint_velocity: Row[float] = lw.part("joints")
    anchor_rotation: Row[wp.spatial_vector] = lw.part()  # x and y axes of the reference's anchor in the robot's anchor
    angular_velocity: Row[wp.vec3] = lw.part()
    joint_position: Row[float] = lw.part("joints")
    joint_velocity: Row[float] = lw.part("joints")
    last_action: Row[float] = lw.part("joints")


@wp.struct
class Policy(Blind):
    anchor_position: Row[wp.vec3] = lw.part()  # of the reference's anchor in the robot's anchor
    linear_velocity: Row[wp.vec3] = lw.part()  # at the velocimeter


@wp.struct
class Critic(Policy):
    body_position: Row[wp.vec3] = lw.part("bodies")  # in the anchor
    body_rotation: Row[wp.spatial_vector] = lw.part("bodies")  # x and y axes in the anchor


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    row = next_row(s, p)
    for j in range(p.joints.shape[0]):
        pose = p.default_pose[j] + p.reference_share * (p.clips[row, 2 + p.joint_qpos[j]] - p.default_pose[j])
        ctrl[p.controls[j]] = pose + p.action_scale[j] * action[j] - s.encoder_bias[j]


@wp.func
def axes(q: lw.quat) -> wp.spatial_vector:
    """Return the x and y axes of a frame."""
    return wp.spatial_vector(lw.quat_rotate(q, wp.vec3(1.0, 0.0, 0.0)), lw.quat_rotate(q, wp.vec3(0.0, 1.0, 0.0)))


@wp.func
def observe_robot(s: World, p: Params, obs: Any):
    """Write what all policies and the critic observe, except the joint positions."""
    row, anchor = next_row(s, p), s.xquat[p.bodies[0]]
    for j in range(p.joints.shape[0]):
        obs.reference_joint_position[j] = p.clips[row, 2 + p.joint_qpos[j]]
        obs.reference_joint_velocity[j] = p.reference_qvel[row, p.joint_dof[j]]
    obs.anchor_rotation[0] = axes(lw.quat_mul(lw.quat_inverse(anchor), p.reference_rotation[row, 0]))
    obs.angular_velocity[0] = terms.angular_velocity(s.qvel)
    terms.gather(obs.joint_velocity, s.qvel, p.joint_dof)
    lw.put(obs.last_action, 0, s.last_action)


@wp.func
def observe_place(s: World, p: Params, obs: Any):
    """Write the observations for which a robot must estimate its position and its velocity."""
    anchor = p.bodies[0]
    to_reference = p.reference_position[next_row(s, p), 0] - s.xpos[anchor]
    obs.anchor_position[0] = lw.quat_rotate_inverse(s.xquat[anchor], to_reference)
    obs.linear_velocity[0] = terms.linear_velocity(s.qpos, s.qvel) + wp.cross(terms.angular_velocity(s.qvel), p.imu)


@wp.func
def observe_noise(s: World, p: Params, obs: Any, rng: Row[wp.uint32]):
    """Write the joint positions as the encoders measure them, and add noise."""
    terms.gather_positions(obs.joint_position, s.qpos, p.joint_qpos, p.default_pose, s.encoder_bias)
    r, rotation = p.randomness, obs.anchor_rotation[0]
    for i in range(6):
        rotation[i] += lw.uniform(rng, -r * p.rotation_noise, r * p.rotation_noise)
    obs.anchor_rotation[0] = rotation
    terms.add_uniform_noise(obs.angular_velocity, r * p.angular_velocity_noise, rng)
    terms.add_uniform_noise(obs.joint_position, r * p.joint_position_noise, rng)
    terms.add_uniform_noise(obs.joint_velocity, r * p.joint_velocity_noise, rng)


@wp.func
def observe(s: World, p: Params, obs: Policy, rng: Row[wp.uint32]):
    observe_robot(s, p, obs)
    observe_place(s, p, obs)
    observe_noise(s, p, obs, rng)
    terms.add_uniform_noise(obs.anchor_position, p.randomness * p.position_noise, rng)
    terms.add_uniform_noise(obs.linear_velocity, p.randomness * p.linear_velocity_noise, rng)


@wp.func
def blind(s: World, p: Params, obs: Blind, rng: Row[wp.uint32]):
    """Observe without an estimate of the robot's position and velocity."""
    observe_robot(s, p, obs)
    observe_noise(s, p, obs, rng)


@wp.func
def observe_critic(s: World, p: Params, obs: Critic):
    observe_robot(s, p, obs)
    observe_place(s, p, obs)
    terms.gather_positions(obs.joint_position, s.qpos, p.joint_qpos, p.default_pose)
    anchor = p.bodies[0]
    for i in range(p.bodies.shape[0]):
        body = p.bodies[i]
        obs.body_position[i] = lw.quat_rotate_inverse(s.xquat[anchor], s.xpos[body] - s.xpos[anchor])
        obs.body_rotation[i] = axes(lw.quat_mul(lw.quat_inverse(s.xquat[anchor]), s.xquat[body]))


# between steps


@wp.func
def substep(s: World, p: Params):
    if wp.length(terms.sensor_vector(s.sensordata, p.self_contact)) > p.contact_force:
        s.collision_time[0] = s.collision_time[0] + p.substep_dt


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    lw.put(s1.last_action, 0, action)
    terms.run_timer(s1.push_timer, p.dt)
    s1.frame[0] = float(next_row(s0, p))


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    if terms.is_due(s.push_timer) and p.randomness > 0.0:
        terms.draw_timer(s.push_timer, p.push_seconds, rng)
        terms.push(s.qpos, s.qvel, p.randomness * p.push_velocity, p.randomness * p.push_spin, rng)


# robots and starts


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    sliding = lw.uniform(rng, p.friction[0], p.friction[1])
    for i in range(p.foot_geoms.shape[0]):
        nominal = s.geom_friction[p.foot_geoms[i]][0]
        s.geom_friction[p.foot_geoms[i]][0] = nominal + p.randomness * (sliding - nominal)
    terms.shift_center_of_mass(s.body_ipos, p.bodies[0], p.randomness * p.anchor_offset, rng)
    terms.draw_row(s.encoder_bias, -p.randomness * p.encoder_bias, p.randomness * p.encoder_bias, rng)


@wp.func
def put_reference(s: World, p: Params, clip: int, frame: int):
    """Put the robot into a frame of a clip, but not into the last one."""
    row = p.ranges[clip, 0] + wp.clamp(frame, 0, p.ranges[clip, 1] - 2)
    s.clip[0] = float(clip)
    s.frame[0] = float(row)
    lw.put(s.qpos, 0, p.clips[row, 2:])
    lw.put(s.qvel, 0, p.reference_qvel[row])


@wp.func
def initialize(s: World, p: Params):
    put_reference(s, p, wp.clamp(p.start_clip, 0, p.ranges.shape[0] - 1), p.start_frame)


@wp.func
def drawn_bin(s: World, p: Params, rng: Row[wp.uint32]) -> int:
    """Draw a bin from the shared probabilities, or without failures before the first update."""
    u = lw.uniform(rng, 0.0, 1.0)
    if s.shared.starts[p.bins.shape[0] - 1] > 0.0:
        return wp.lower_bound(s.shared.starts, u)
    return wp.lower_bound(p.bin_starts, u)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    b = drawn_bin(s, p, rng)
    clip = int(p.bins[b, 0])
    frame = p.bins[b, 1] - p.ranges[clip, 0] + terms.uniform_int(rng, 0, p.bins[b, 2] - 1)
    if p.start_clip >= 0:
        clip = wp.min(p.start_clip, p.ranges.shape[0] - 1)
        frame = terms.uniform_int(rng, 0, p.ranges[clip, 1] - 2)
    if p.start_frame >= 0:
        frame = int(p.start_frame)
    put_reference(s, p, clip, frame)
    r = p.randomness
    offset = lw.uniform(rng, -r * p.start_position, r * p.start_position)
    for i in range(3):
        s.qpos[i] += offset[i]
    turn = lw.quat_from_euler(lw.uniform(rng, -r * p.start_rotation, r * p.start_rotation))
    lw.put(s.qpos, 3, lw.quat_mul(turn, terms.orientation(s.qpos)))
    terms.push(s.qpos, s.qvel, r * p.push_velocity, r * p.push_spin, rng)
    for j in range(p.joints.shape[0]):
        limits, q = s.jnt_range[p.joints[j]], s.qpos[p.joint_qpos[j]]
        middle, half = 0.5 * (limits[0] + limits[1]), 0.5 * p.soft_limit * (limits[1] - limits[0])
        noisy = wp.clamp(q + lw.uniform(rng, -r * p.start_joint, r * p.start_joint), middle - half, middle + half)
        s.qpos[p.joint_qpos[j]] = wp.where(r > 0.0, noisy, q)
    terms.draw_timer(s.push_timer, p.push_seconds, rng)


# failures


@wp.func
def tally(s0: World, action: Row[float], s1: World, p: Params, ended: bool, sums: Sums, terminated: bool):
    if ended:
        sums.episodes[0] = 1.0
    if terminated:
        sums.failures[wp.lower_bound(p.bin_ends, int(s1.frame[0]))] = 1.0


@wp.func
def share(shared: Shared, sums: Sums, p: Params):
    keep = 1.0 - p.forgetting
    shared.episodes[0] = keep * shared.episodes[0] + sums.episodes[0]
    n = p.bins.shape[0]
    for b in range(n):
        shared.failures[b] = keep * shared.failures[b] + sums.failures[b]
    total = float(0.0)
    for b in range(n):
        failures, factor, norm = float(0.0), float(1.0), float(0.0)
        for i in range(b, wp.min(b + p.earlier_bins, n)):
            if p.bins[i, 0] == p.bins[b, 0]:
                failures += factor * shared.failures[i]
            norm += factor
            factor *= p.earlier_decay
        if p.bins[b, 2] > 0:
            share = p.bin_starts[b] - wp.where(b > 0, p.bin_starts[wp.max(b - 1, 0)], 0.0)
            rate = p.clips[p.bins[b, 1], 1] * failures / (norm * wp.max(shared.episodes[0], 1.0))
            total += p.failure_weight * rate + p.uniform_weight * share
        shared.starts[b] = total
    for b in range(n):
        shared.starts[b] = shared.starts[b] / total


def prepare(spec: mujoco.MjSpec, feet: Sequence[str], **options: Any) -> None:
    """Prepare a model as ``walkers.prepare_walker`` does, but measure only forces between parts of the robot."""
    walkers.prepare_walker(spec, feet, **options)
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    walkers.add_self_contact(spec, "self_contact")


def deployment(model: mujoco.MjModel, p: Any, memory: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Collect what a robot needs to follow a clip, or a stream of reference frames."""
    return walkers.base_metadata(model, p) | {
        "reference_share": float(p.reference_share),
        "anchor": model.body(p.bodies[0]).name,
        "bodies": [model.body(body).name for body in p.bodies],
        "reference": "positions and velocities of the joints and the pose of the anchor, at the end of the step",
    }


def mirror(model: mujoco.MjModel, p: Any) -> lw.Mirror:
    """Add the reference and the tracked bodies to ``walkers.mirror``."""
    parts, flip, axes = walkers.mirror(model, p).parts, np.array([1, -1, 1]), np.array([1, -1, 1, -1, 1, -1])
    names = [f"the tracked body {model.body(body).name!r}" for body in p.bodies]
    order = walkers.mirror_order(walkers.straight(model).xpos[p.bodies], names)
    reference = {f"reference_{name}": parts[name] for name in ("joint_position", "joint_velocity")}
    bodies = {"body_position": walkers.mirror_rows(order, flip), "body_rotation": walkers.mirror_rows(order, axes)}
    return lw.Mirror({**parts, **reference, **bodies, "anchor_position": flip, "anchor_rotation": axes})


def ghost(p: Any, state: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the coordinates of the reference."""
    return np.asarray(p.clips)[int(state["frame"][0]), 2:]


class Tracking(lw.Task):
    """A robot that follows clips."""

    frame_skip, horizon = 4, 500
    gate = gates.Tracks()
    physics = {
        "coarse": lw.PhysicsOptions(
            integrator="discrete", frame_skip=2, timestep=0.01, solver={"iterations": 4, "ls_iterations": 8}
        )
    }
    # with standard deviations of 1, action_rate_l2 costs more than perfect tracking earns, and robots learn to fall
    training = lw.Training(
        algorithm="ppo", settings={"entropy_coef": 0.005, "log_std": -1.0}, iterations=3000, physics="coarse"
    )
    actions = {"joint_position": "joints"}
    rewards = {
        "anchor_position": 0.5,
        "anchor_rotation": 0.5,
        "body_position": 1.0,
        "body_rotation": 1.0,
        "body_velocity": 1.0,
        "body_spin": 1.0,
        "action_rate_l2": -0.1,
        "joint_limits": -10.0,
        "self_collision": -10.0,
    }
    terminations, truncations = ("anchor_height", "anchor_tilt", "end_height"), ("clip_end",)
    metrics = (
        "mpkpe", "r_mpkpe", "joint_position_error", "joint_velocity_error", "end_position_error", "end_rotation_error",
        "base_height_error", "base_tilt_error",
    )  # fmt: skip
    deployment, ghost, mirror = staticmethod(deployment), staticmethod(ghost), staticmethod(mirror)
    cleared = ("sensordata",)  # a reset clears the forces
