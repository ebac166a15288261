"""SoftBall: grip a soft ball with two fingers and lift it to a target (a flex).

The ball is deformable. A grip must be firm enough to hold it and costs reward as it squeezes the ball out of shape.
The policy sees the place, the velocity and the widths of the ball, as its vertices have them. An episode is a success
while the ball stays within 3 cm of the target for half a second.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

NODES = 8
"""Corners of the box that the ball deforms with. Their coordinates follow those of the gripper's four joints."""
FIRST = 4


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    site_xpos: Row[wp.vec3]
    flexvert_xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]
    memory: Row[float]  # steps that the ball has spent at the target without a break


@wp.struct
class Params:
    dt: float
    success_distance: float = 0.03
    success_time: float = 0.5
    squeeze_weight: float = 1.0
    reach: float = 0.4  # metres from the middle at which the ball is lost
    diameter: float = 0.09
    crushed: float = 0.06  # width at which the ball is crushed
    start_range: float = 0.2
    target_low: wp.vec3 = wp.vec3(-0.15, 0.0, 0.15)
    target_high: wp.vec3 = wp.vec3(0.15, 0.0, 0.3)
    grip: int = lw.site("grip")
    target: int = lw.mocap("target")


@wp.func
def centre(s: World) -> wp.vec3:
    total = wp.vec3()
    for i in range(s.flexvert_xpos.shape[0]):
        total += s.flexvert_xpos[i]
    return total / float(s.flexvert_xpos.shape[0])


@wp.func
def velocity(s: World) -> wp.vec3:
    total = wp.vec3()
    for i in range(NODES):
        for j in range(3):
            total[j] += s.qvel[FIRST + 3 * i + j] / float(NODES)
    return total


@wp.func
def widths(s: World) -> wp.vec3:
    low, high = wp.vec3(s.flexvert_xpos[0]), wp.vec3(s.flexvert_xpos[0])
    for i in range(s.flexvert_xpos.shape[0]):
        low, high = wp.min(low, s.flexvert_xpos[i]), wp.max(high, s.flexvert_xpos[i])
    return high - low


@wp.func
def distance(s: World, p: Params) -> float:
    return wp.length(centre(s) - s.mocap_pos[p.target])


@wp.func
def terms(s: World, p: Params) -> wp.vec3:
    squeeze = 1.0 - widths(s)[0] / p.diameter
    return wp.vec3(
        lw.tolerance(wp.length(centre(s) - s.site_xpos[p.grip]), wp.vec2(0.0, 0.01), 0.2),
        lw.tolerance(distance(s, p), wp.vec2(0.0, 0.01), 0.3),
        p.squeeze_weight * squeeze * squeeze,
    )


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    ball = centre(s)
    k = lw.put(obs, 0, s.qpos, 0, 3)
    k = lw.put(obs, k, s.qvel, 0, 3)
    k = lw.put(obs, k, ball)
    k = lw.put(obs, k, velocity(s))
    k = lw.put(obs, k, widths(s))
    k = lw.put(obs, k, s.site_xpos[p.grip] - ball)
    k = lw.put(obs, k, s.mocap_pos[p.target] - ball)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    t = terms(s1, p)
    return t[0] * (0.25 + 0.75 * t[1]) - t[2]


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    k = lw.put(metrics, 0, terms(s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return distance(s, p)


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.memory[0] = wp.where(distance(s1, p) < p.success_distance, s0.memory[0] + 1.0, 0.0)


@wp.func
def success(s: World, p: Params) -> bool:
    return s.memory[0] * p.dt >= p.success_time


@wp.func
def terminated(s: World, p: Params) -> bool:
    return wp.length(centre(s)) > p.reach or wp.min(widths(s)) < p.crushed


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    x = lw.uniform(rng, -p.start_range, p.start_range)
    for i in range(NODES):
        s.qpos[FIRST + 3 * i] += x
    for i in range(3):
        s.mocap_pos[p.target][i] = lw.uniform(rng, p.target_low[i], p.target_high[i])


@lw.register
class SoftBall(lw.Task):
    model = "soft_ball.xml"
    frame_skip = 4
    obs = {"gripper": 3, "gripper_velocity": 3, "ball": 3, "ball_velocity": 3, "widths": 3, "to_grip": 3, "to_target": 3}
    metrics = ("near", "lifted", "squeezed")
    horizon = 200
    memory = 1
    action_range = (-1.0, 1.0)
