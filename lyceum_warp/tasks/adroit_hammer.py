"""AdroitHammer: pick up a hammer and drive a nail into a board (Gymnasium-Robotics' AdroitHandHammer-v1).

Install the extra "hand" to get the hand's model. The board is a mocap body, so that its height is part of the state.
The original model contains one contact pair twice: the tips of ring finger and little finger. This model contains it
once. As in Gymnasium-Robotics, positions and the force on the nail are one substep old after ``mj_step``. Because of a
mistake in gymnasium-robotics 1.2.1 to 1.4.2, the reward grows with the palm's distance from the hammer.
``palm_weight=-0.1`` restores the reward of version 1.2.0.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

vec5 = wp.types.vector(length=5, dtype=wp.float32)


@wp.struct
class World:
    qpos: Row[float]  # 2 joints of the arm, 24 of the hand, the nail, 3 slides and 3 hinges of the hammer
    qvel: Row[float]
    xpos: Row[wp.vec3]
    xquat: Row[lw.quat]
    site_xpos: Row[wp.vec3]
    sensordata: Row[float]
    mocap_pos: Row[wp.vec3]


@wp.struct
class Params:
    sparse: bool = False  # the reward is 10 for success, otherwise -0.1
    palm_weight: float = 0.1
    success_distance: float = 0.01  # m, from the nail's head to the goal
    board_height: wp.vec2 = wp.vec2(0.1, 0.25)
    hammer: int = lw.body("Object")
    head: int = lw.site("tool")
    palm: int = lw.site("S_grasp")
    nail: int = lw.site("S_target")
    goal: int = lw.site("nail_goal")  # target position of the nail's head
    board: int = lw.mocap("nail_board")
    nail_force: int = lw.sensor("S_nail")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 0, 27)
    for i in range(27, 33):
        k = lw.put(obs, k, wp.clamp(s.qvel[i], -1.0, 1.0))
    k = lw.put(obs, k, s.site_xpos[p.palm])
    k = lw.put(obs, k, s.xpos[p.hammer])
    k = lw.put(obs, k, lw.quat_to_euler(s.xquat[p.hammer]))
    k = lw.put(obs, k, s.site_xpos[p.nail])
    lw.put(obs, k, wp.clamp(s.sensordata[p.nail_force], -1.0, 1.0))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.length(s.site_xpos[p.nail] - s.site_xpos[p.goal])


@wp.func
def success(s: World, p: Params) -> bool:
    return evaluate(s, p) < p.success_distance


@wp.func
def terms(s: World, p: Params) -> vec5:
    to_hammer = wp.length(s.site_xpos[p.palm] - s.xpos[p.hammer])
    to_nail = wp.length(s.site_xpos[p.head] - s.site_xpos[p.nail])
    speed = wp.sqrt(lw.sum_squares(s.qvel))
    bonus = wp.where(s.xpos[p.hammer][2] > 0.04 and s.site_xpos[p.head][2] > 0.04, 2.0, 0.0)
    bonus += wp.where(evaluate(s, p) < 0.02, 25.0, 0.0) + wp.where(evaluate(s, p) < 0.01, 75.0, 0.0)
    return vec5(p.palm_weight * to_hammer, -to_nail, -10.0 * evaluate(s, p), -0.01 * speed, bonus)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    if p.sparse:
        return wp.where(success(s1, p), 10.0, -0.1)
    t = terms(s1, p)
    return t[0] + t[1] + t[2] + t[3] + t[4]


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s1, p))


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.mocap_pos[p.board][2] = lw.uniform(rng, p.board_height[0], p.board_height[1])


@lw.register
class AdroitHammer(lw.Task):
    model = lw.gymnasium_robotics_model("adroit_hand/adroit_hammer.xml")
    gymnasium = "AdroitHandHammer-v1"
    frame_skip = 5
    obs = {"joints": 26, "nail_depth": 1, "velocity": 6, "palm": 3, "hammer": 3, "euler": 3, "nail": 3, "force": 1}
    metrics = ("palm_to_hammer", "head_to_nail", "nail_to_goal", "speed", "bonus")
    horizon = 200
    lagged = ("xpos", "xquat", "site_xpos", "sensordata")
    action_range = (-1.0, 1.0)
    planning = lw.Planning(
        settings={"horizon": 32, "samples": 160, "temperature": 0.1, "noise": 1.0}, params={"palm_weight": -1.0}
    )

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        spec.body("nail_board").mocap = True
