"""Pusher: push a cylinder to a goal with a 7-joint arm (Gymnasium's Pusher-v5).

As in Gymnasium, body positions are one substep old after ``mj_step``. Success: the cylinder's centre is over the goal's
disc. Gymnasium defines no success.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # 7 angles, y and x of the cylinder, y and x of the goal, relative to the model's positions
    qvel: Row[float]
    xpos: Row[wp.vec3]


@wp.struct
class Params:
    reward_near_weight: float = 0.5
    reward_dist_weight: float = 1.0
    reward_control_weight: float = 0.1
    success_distance: float = 0.08  # radius of the disc
    tips: int = lw.body("tips_arm")
    cylinder: int = lw.body("object")
    goal: int = lw.body("goal")


@wp.func
def distance(s: World, p: Params) -> float:
    return wp.length(s.xpos[p.cylinder] - s.xpos[p.goal])


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 0, 7)
    k = lw.put(obs, k, s.qvel, 0, 7)
    k = lw.put(obs, k, s.xpos[p.tips])
    k = lw.put(obs, k, s.xpos[p.cylinder])
    lw.put(obs, k, s.xpos[p.goal])


@wp.func
def terms(action: Row[float], s1: World, p: Params) -> wp.vec3:
    near = wp.length(s1.xpos[p.cylinder] - s1.xpos[p.tips])
    effort = p.reward_control_weight * lw.sum_squares(action)
    return wp.vec3(-p.reward_dist_weight * distance(s1, p), -effort, -p.reward_near_weight * near)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.dot(terms(action, s1, p), wp.vec3(1.0))


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(action, s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return distance(s, p)


@wp.func
def success(s: World, p: Params) -> bool:
    return distance(s, p) < p.success_distance


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    offset = wp.vec2(0.0, 0.0)
    while wp.length(offset) <= 0.17:  # the cylinder does not start near the goal
        offset = lw.uniform(rng, wp.vec2(-0.3, -0.2), wp.vec2(0.0, 0.2))
    lw.put(s.qpos, 7, offset)
    for i in range(7):
        s.qvel[i] += lw.uniform(rng, -0.005, 0.005)


@lw.register
class Pusher(lw.Task):
    model, frame_skip, gymnasium = "pusher_v5.xml", 5, "Pusher-v5"
    obs = {"position": 7, "velocity": 7, "tips": 3, "cylinder": 3, "goal": 3}
    metrics = ("reward_dist", "reward_ctrl", "reward_near")
    horizon = 100
    lagged = ("xpos",)
