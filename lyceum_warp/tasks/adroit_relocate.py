"""AdroitRelocate: pick up a ball and carry it to a target (Gymnasium-Robotics' AdroitHandRelocate-v1).

Install the extra "hand" to get the hand's model. The target is a mocap body, so that its position is part of the state.
Resets set the positions of the ball's joints, which are also part of the state. The original model contains one
contact pair twice: the tips of ring finger and little finger. This model contains it once. As in Gymnasium-Robotics,
positions are one substep old after ``mj_step``. Because of a mistake in gymnasium-robotics 1.2.1 to 1.4.2, the reward
grows with the palm's distance from the ball. ``palm_weight=-0.1`` restores the reward of version 1.2.0.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # 6 joints of the arm, 24 of the hand, 3 slides and 3 hinges of the ball
    xpos: Row[wp.vec3]
    site_xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]


@wp.struct
class Params:
    sparse: bool = False  # the reward is 10 for success, otherwise -0.1
    palm_weight: float = 0.1
    success_distance: float = 0.1  # m
    lifted_height: float = 0.04  # m; the ball has a radius of 0.035
    ball_low: wp.vec2 = wp.vec2(-0.15, -0.15)
    ball_high: wp.vec2 = wp.vec2(0.15, 0.3)
    target_low: wp.vec3 = wp.vec3(-0.2, -0.2, 0.15)
    target_high: wp.vec3 = wp.vec3(0.2, 0.2, 0.35)
    ball: int = lw.body("Object")
    ball_x: int = lw.qpos("OBJTx")
    palm: int = lw.site("S_grasp")
    target: int = lw.mocap("target")
    target_site: int = lw.site("target")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    palm, ball, target = s.site_xpos[p.palm], s.xpos[p.ball], s.site_xpos[p.target_site]
    k = lw.put(obs, 0, s.qpos, 0, 30)
    k = lw.put(obs, k, palm - ball)
    k = lw.put(obs, k, palm - target)
    lw.put(obs, k, ball - target)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.length(s.xpos[p.ball] - s.site_xpos[p.target_site])


@wp.func
def success(s: World, p: Params) -> bool:
    return evaluate(s, p) < p.success_distance


@wp.func
def terms(s: World, p: Params) -> wp.vec3:
    palm = s.site_xpos[p.palm]
    carried = float(0.0)
    if s.xpos[p.ball][2] > p.lifted_height:
        carried = 1.0 - 0.5 * wp.length(palm - s.site_xpos[p.target_site]) - 0.5 * evaluate(s, p)
    bonus = wp.where(evaluate(s, p) < 0.1, 10.0, 0.0) + wp.where(evaluate(s, p) < 0.05, 20.0, 0.0)
    return wp.vec3(p.palm_weight * wp.length(palm - s.xpos[p.ball]), carried, bonus)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    if p.sparse:
        return wp.where(success(s1, p), 10.0, -0.1)
    t = terms(s1, p)
    return t[0] + t[1] + t[2]


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s1, p))


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    lw.put(s.qpos, p.ball_x, lw.uniform(rng, p.ball_low, p.ball_high))  # the model places the body above (0, 0)
    s.mocap_pos[p.target] = lw.uniform(rng, p.target_low, p.target_high)


@lw.register
class AdroitRelocate(lw.Task):
    model = lw.gymnasium_robotics_model("adroit_hand/adroit_relocate.xml")
    gymnasium = "AdroitHandRelocate-v1"
    frame_skip = 5
    obs = {"joints": 30, "palm_to_ball": 3, "palm_to_target": 3, "ball_to_target": 3}
    metrics = ("palm_to_ball", "carried", "bonus")
    horizon = 200
    lagged = ("xpos", "site_xpos")
    action_range = (-1.0, 1.0)
    planning = lw.Planning(
        settings={"horizon": 32, "samples": 160, "temperature": 0.1, "noise": 0.3}, params={"palm_weight": -1.0}
    )

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        fixed = spec.site("target")
        target = spec.worldbody.add_body(name="target", mocap=True, pos=fixed.pos)
        looks = {"size": fixed.size.copy(), "rgba": fixed.rgba.copy()}
        spec.delete(fixed)
        target.add_site(name="target", **looks)
