"""Reacher: move the tip of a planar arm of two links to a target (Gymnasium's Reacher-v5).

As in Gymnasium, body positions are one substep old after ``mj_step``. Success: the tip touches the target. Gymnasium
defines no success.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # two angles, x and y of the target
    qvel: Row[float]
    xpos: Row[wp.vec3]


@wp.struct
class Params:
    reward_dist_weight: float = 1.0
    reward_control_weight: float = 1.0
    success_distance: float = 0.019  # sum of both spheres' radii
    fingertip: int = lw.body("fingertip")
    target: int = lw.body("target")


@wp.func
def error(s: World, p: Params) -> wp.vec3:
    return s.xpos[p.fingertip] - s.xpos[p.target]


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    for i in range(2):
        obs[i] = wp.cos(s.qpos[i])
        obs[2 + i] = wp.sin(s.qpos[i])
        obs[4 + i] = s.qpos[2 + i]
        obs[6 + i] = s.qvel[i]
        obs[8 + i] = error(s, p)[i]


@wp.func
def terms(action: Row[float], s1: World, p: Params) -> wp.vec2:
    distance = wp.length(error(s1, p))
    return wp.vec2(-p.reward_dist_weight * distance, -p.reward_control_weight * lw.sum_squares(action))


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.dot(terms(action, s1, p), wp.vec2(1.0))


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(action, s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.length(error(s, p))


@wp.func
def success(s: World, p: Params) -> bool:
    return wp.length(error(s, p)) < p.success_distance


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(2):
        s.qpos[i] += lw.uniform(rng, -0.1, 0.1)
        s.qvel[i] += lw.uniform(rng, -0.005, 0.005)
    goal = wp.vec2(0.2, 0.2)
    while wp.length(goal) >= 0.2:  # the target is anywhere within the arm's length
        goal = lw.uniform(rng, wp.vec2(-0.2), wp.vec2(0.2))
    lw.put(s.qpos, 2, goal)


@lw.register
class Reacher(lw.Task):
    model, frame_skip, gymnasium = "reacher.xml", 2, "Reacher-v5"
    obs = {"cosines": 2, "sines": 2, "target": 2, "velocity": 2, "error": 2}
    metrics = ("reward_dist", "reward_ctrl")
    horizon = 50
    lagged = ("xpos",)
