"""AdroitPen: turn a pen in the hand to a target orientation (Gymnasium-Robotics' AdroitHandPen-v1).

Install the extra "hand" to get the hand's model. The target is a mocap body, so that its pose is part of the state.
Unlike in Gymnasium-Robotics, the pen does not collide with the target. The original model contains one contact pair
twice: the tips of ring finger and little finger. This model contains it once. As in Gymnasium-Robotics, positions are
one substep old after ``mj_step``. Success: the pen has been in the goal orientation in more than 20 steps of the
episode.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # 24 joints of the hand, 3 slides and 3 hinges of the pen
    qvel: Row[float]
    xpos: Row[wp.vec3]
    site_xpos: Row[wp.vec3]
    mocap_quat: Row[lw.quat]
    steps_at_goal: Row[float] = lw.memory()  # in this episode


@wp.struct
class Params:
    sparse: bool = False  # the reward is 10 at the goal, otherwise -0.1
    goal_distance: float = 0.075
    goal_similarity: float = 0.95
    goal_steps: float = 20.0
    near_similarity: float = 0.9
    drop_height: float = 0.075
    target_range: float = 1.0  # bound of the target's first two Euler angles, rad
    pen: int = lw.body("Object")
    pen_top: int = lw.site("object_top")
    pen_bottom: int = lw.site("object_bottom")
    target: int = lw.mocap("target")
    target_top: int = lw.site("target_top")
    target_bottom: int = lw.site("target_bottom")
    palm: int = lw.site("eps_ball")  # the pen's goal position


@wp.func
def axis(s: World, top: int, bottom: int) -> wp.vec3:
    return wp.normalize(s.site_xpos[top] - s.site_xpos[bottom])


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    pen, target = axis(s, p.pen_top, p.pen_bottom), axis(s, p.target_top, p.target_bottom)
    k = lw.put(obs, 0, s.qpos, 0, 24)
    k = lw.put(obs, k, s.xpos[p.pen])
    k = lw.put(obs, k, s.qvel, 24, 30)
    k = lw.put(obs, k, pen)
    k = lw.put(obs, k, target)
    k = lw.put(obs, k, s.xpos[p.pen] - s.site_xpos[p.palm])
    lw.put(obs, k, pen - target)


@wp.func
def evaluate(s: World, p: Params) -> float:  # the cosine of the angle between the pen's axis and the target's
    return wp.dot(axis(s, p.pen_top, p.pen_bottom), axis(s, p.target_top, p.target_bottom))


@wp.func
def held(s: World, p: Params, similarity: float) -> bool:
    return wp.length(s.xpos[p.pen] - s.site_xpos[p.palm]) < p.goal_distance and evaluate(s, p) > similarity


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    if p.sparse:
        return wp.where(held(s1, p, p.goal_similarity), 10.0, -0.1)
    bonus = wp.where(held(s1, p, p.near_similarity), 10.0, 0.0) + wp.where(held(s1, p, p.goal_similarity), 50.0, 0.0)
    dropped = wp.where(s1.xpos[p.pen][2] < p.drop_height, -5.0, 0.0)
    return evaluate(s1, p) - wp.length(s1.xpos[p.pen] - s1.site_xpos[p.palm]) + bonus + dropped


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.steps_at_goal[0] = s0.steps_at_goal[0] + float(held(s1, p, p.goal_similarity))


@wp.func
def success(s: World, p: Params) -> bool:
    return s.steps_at_goal[0] > p.goal_steps


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    x = lw.uniform(rng, -p.target_range, p.target_range)
    y = lw.uniform(rng, -p.target_range, p.target_range)
    s.mocap_quat[p.target] = lw.quat_from_euler(wp.vec3(x, y, 0.0))


@lw.register
class AdroitPen(lw.Task):
    model = lw.gymnasium_robotics_model("adroit_hand/adroit_pen.xml")
    gymnasium = "AdroitHandPen-v1"
    frame_skip, horizon = 5, 200
    obs = {
        "joints": 24, "position": 3, "velocity": 6, "axis": 3, "target_axis": 3, "position_error": 3, "axis_error": 3,
    }  # fmt: skip
    lagged = ("xpos", "site_xpos")
    action_range = (-1.0, 1.0)
    planning = lw.Planning(settings={"horizon": 32, "samples": 160, "temperature": 1.0, "noise": 1.0})  # the paper's

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        spec.body("target").mocap = True
        for geom in spec.body("target").geoms:
            geom.contype = geom.conaffinity = 0
