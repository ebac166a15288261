"""SoftBall: grip a soft ball (a flex) with two fingers, and lift it to a target.

Squeezing the ball costs reward, and crushing it to two thirds of its width ends the episode. The policy observes the
mean and the extents of the ball's vertices. Success: the ball has been within 3 cm of the target for half a second.
MuJoCo Warp merges flex contacts less than 1 mm apart, so the engines differ if the ball is squeezed hard.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

NODE = 4  # first of the ball's indices in qpos and qvel: 8 flex nodes with 3 coordinates each


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    site_xpos: Row[wp.vec3]
    flexvert_xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]


@wp.struct
class Params:
    success_distance: float = 0.03
    reach: float = 0.4  # largest distance of the ball from the origin, m
    diameter: float = 0.09
    start_range: float = 0.2  # largest initial x of ball and target, m
    heights: wp.vec2 = wp.vec2(0.15, 0.3)  # of the target, m
    grip: int = lw.site("grip")
    target: int = lw.mocap("target")


@wp.func
def centre(s: World) -> wp.vec3:
    total = wp.vec3()
    for i in range(s.flexvert_xpos.shape[0]):
        total += s.flexvert_xpos[i]
    return total / float(s.flexvert_xpos.shape[0])


@wp.func
def widths(s: World) -> wp.vec3:
    low, high = wp.vec3(s.flexvert_xpos[0]), wp.vec3(s.flexvert_xpos[0])
    for i in range(s.flexvert_xpos.shape[0]):
        low, high = wp.min(low, s.flexvert_xpos[i]), wp.max(high, s.flexvert_xpos[i])
    return high - low


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.length(centre(s) - s.mocap_pos[p.target])


@wp.func
def terms(s: World, p: Params) -> wp.vec3:
    near = lw.tolerance(wp.length(centre(s) - s.site_xpos[p.grip]), wp.vec2(0.0, 0.01), 0.2)
    squeeze = 1.0 - widths(s)[0] / p.diameter
    return wp.vec3(near, lw.tolerance(evaluate(s, p), wp.vec2(0.0, 0.01), 0.3), squeeze * squeeze)


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    ball, velocity = centre(s), wp.vec3()
    for i in range(NODE, s.qvel.shape[0]):
        velocity[(i - NODE) % 3] += s.qvel[i] / 8.0
    k = lw.put(obs, 0, s.qpos, 0, 3)
    k = lw.put(obs, k, s.qvel, 0, 3)
    k = lw.put(obs, k, ball)
    k = lw.put(obs, k, velocity)
    k = lw.put(obs, k, widths(s))
    k = lw.put(obs, k, s.site_xpos[p.grip] - ball)
    k = lw.put(obs, k, s.mocap_pos[p.target] - ball)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    t = terms(s1, p)
    return t[0] * (0.25 + 0.75 * t[1]) - t[2]


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s1, p))


@wp.func
def success(s: World, p: Params) -> bool:
    return evaluate(s, p) < p.success_distance


@wp.func
def terminated(s: World, p: Params) -> bool:
    return wp.length(centre(s)) > p.reach or wp.min(widths(s)) < p.diameter / 1.5


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    x = lw.uniform(rng, -p.start_range, p.start_range)
    for i in range(NODE, s.qpos.shape[0], 3):
        s.qpos[i] += x
    s.mocap_pos[p.target][0] = lw.uniform(rng, -p.start_range, p.start_range)
    s.mocap_pos[p.target][2] = lw.uniform(rng, p.heights[0], p.heights[1])


@lw.register
class SoftBall(lw.Task):
    model = "soft_ball.xml"
    frame_skip, horizon, success_steps = 4, 200, 25
    obs = {"gripper": 3, "gripper_speed": 3, "ball": 3, "ball_velocity": 3, "widths": 3, "to_grip": 3, "to_target": 3}
    metrics = ("near", "lifted", "squeezed")
    action_range = (-1.0, 1.0)
