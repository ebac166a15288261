"""HerbReach: move the hands of two 7-joint Barrett arms to targets in space (HERB in the Lyceum paper).

The paper's model is not published, so this model uses published data of the robot (see herb.xml). An action is a
fraction of each motor's peak torque, fingers included. The motors add it to gravity compensation. The targets are drawn
from two boxes within reach, in front of the shoulders. Episodes start near HERB's home position. Success: both palms
have been within 5 cm of their targets for ten consecutive steps, 0.2 s. If two boxes of the arms touch, MuJoCo Warp
finds fewer contact points than MuJoCo.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # 15 joints of the left arm and hand, 15 of the right arm and hand
    qvel: Row[float]
    site_xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]


@wp.struct
class Params:
    success_distance: float = 0.05
    precision_weight: float = 0.5
    ctrl_cost_weight: float = 0.01
    target_low: wp.vec3 = wp.vec3(0.6, 0.1, 0.7)  # box of the left target; mirrored in y for the right target
    target_high: wp.vec3 = wp.vec3(0.95, 0.6, 1.3)
    reset_noise_scale: float = 0.1  # largest initial joint angle of the arms, rad
    left_arm: int = lw.qpos("left/j1")
    right_arm: int = lw.qpos("right/j1")
    left_palm: int = lw.site("left/palm")
    right_palm: int = lw.site("right/palm")
    left_target: int = lw.mocap("left_target")
    right_target: int = lw.mocap("right_target")


@wp.func
def error(s: World, target: int, palm: int) -> wp.vec3:
    return s.mocap_pos[target] - s.site_xpos[palm]


@wp.func
def distances(s: World, p: Params) -> wp.vec2:
    left, right = error(s, p.left_target, p.left_palm), error(s, p.right_target, p.right_palm)
    return wp.vec2(wp.length(left), wp.length(right))


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos)
    k = lw.put(obs, k, s.qvel)
    k = lw.put(obs, k, s.site_xpos[p.left_palm])
    k = lw.put(obs, k, s.site_xpos[p.right_palm])
    k = lw.put(obs, k, error(s, p.left_target, p.left_palm))
    lw.put(obs, k, error(s, p.right_target, p.right_palm))


@wp.func
def terms(action: Row[float], s: World, p: Params) -> wp.vec3:
    d, zero, margin = distances(s, p), wp.vec2(0.0), p.success_distance
    precision = p.precision_weight * (lw.tolerance(d[0], zero, margin) + lw.tolerance(d[1], zero, margin))
    return wp.vec3(-d[0] - d[1], precision, -p.ctrl_cost_weight * lw.sum_squares(action))


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.dot(terms(action, s1, p), wp.vec3(1.0))


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(action, s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.max(distances(s, p))


@wp.func
def success(s: World, p: Params) -> bool:
    return evaluate(s, p) < p.success_distance


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(7):
        s.qpos[p.left_arm + i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
        s.qpos[p.right_arm + i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
    for i in range(3):
        s.mocap_pos[p.left_target][i] = lw.uniform(rng, p.target_low[i], p.target_high[i])
        s.mocap_pos[p.right_target][i] = lw.uniform(rng, p.target_low[i], p.target_high[i])
    s.mocap_pos[p.right_target][1] = -s.mocap_pos[p.right_target][1]


# the wrist's links are light, and more noise would only shake the hand
ARM_NOISE, FINGER_NOISE = (0.14, 0.07, 0.035, 0.1, 0.02, 0.02, 0.02), (0.0, 0.0, 0.0, 0.0)


@lw.register
class HerbReach(lw.Task):
    model = "herb.xml"
    keyframe = "home"
    frame_skip = 10
    obs = {"position": 30, "velocity": 30, "palms": 6, "errors": 6}
    metrics = ("reaching", "precision", "effort")
    horizon = 100
    success_steps = 10
    planning = lw.Planning(
        settings={"horizon": 12, "samples": 64, "noise": 2 * (ARM_NOISE + FINGER_NOISE), "include_plan": False}
    )
