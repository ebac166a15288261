"""AdroitPen: turn a pen in the hand until it points as the target does (Gymnasium-Robotics' AdroitHandPen-v1).

The hand's model comes with the extra "hand". The target is a mocap body here, so that it belongs to the state, and
nothing collides with it; in the original, the pen can collide with the target. The tips of ring and little finger,
which the model pairs twice, are paired once. As in the original, positions are those that ``mj_step`` leaves. An
episode is a success once the pen was held in the goal orientation for more than 20 steps in all.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # the hand's 24 joints, then the pen's 3 slides and 3 hinges
    qvel: Row[float]
    xpos: Row[wp.vec3]
    site_xpos: Row[wp.vec3]
    mocap_quat: Row[lw.quat]
    memory: Row[float]  # steps of the episode at the goal


@wp.struct
class Params:
    dt: float
    goal_distance: float = 0.075
    goal_similarity: float = 0.95
    goal_steps: float = 20.0
    near_similarity: float = 0.9
    drop_height: float = 0.075
    target_range: float = 1.0  # of the target's first two Euler angles
    pen: int = lw.body("Object")
    pen_top: int = lw.site("object_top")
    pen_bottom: int = lw.site("object_bottom")
    target: int = lw.mocap("target")
    target_top: int = lw.site("target_top")
    target_bottom: int = lw.site("target_bottom")
    palm: int = lw.site("eps_ball")  # where the pen belongs


@wp.func
def axis(s: World, top: int, bottom: int) -> wp.vec3:
    along = s.site_xpos[top] - s.site_xpos[bottom]
    return along / wp.length(along)


@wp.func
def distance(s: World, p: Params) -> float:
    return wp.length(s.xpos[p.pen] - s.site_xpos[p.palm])


@wp.func
def similarity(s: World, p: Params) -> float:
    return wp.dot(axis(s, p.pen_top, p.pen_bottom), axis(s, p.target_top, p.target_bottom))


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    position, centre = s.xpos[p.pen], s.site_xpos[p.palm]
    pen, wanted = axis(s, p.pen_top, p.pen_bottom), axis(s, p.target_top, p.target_bottom)
    for i in range(24):
        obs[i] = s.qpos[i]
    for i in range(3):
        obs[24 + i] = position[i]
        obs[33 + i] = pen[i]
        obs[36 + i] = wanted[i]
        obs[39 + i] = position[i] - centre[i]
        obs[42 + i] = pen[i] - wanted[i]
    for i in range(6):
        obs[27 + i] = s.qvel[24 + i]


@wp.func
def at_goal(s: World, p: Params) -> bool:
    return distance(s, p) < p.goal_distance and similarity(s, p) > p.goal_similarity


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    r = similarity(s1, p) - distance(s1, p)
    if distance(s1, p) < p.goal_distance and similarity(s1, p) > p.near_similarity:
        r += 10.0
    if at_goal(s1, p):
        r += 50.0
    if s1.xpos[p.pen][2] < p.drop_height:
        r -= 5.0
    return r


@wp.func
def evaluate(s: World, p: Params) -> float:
    return similarity(s, p)


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.memory[0] = s0.memory[0] + float(at_goal(s1, p))


@wp.func
def success(s: World, p: Params) -> bool:
    return s.memory[0] > p.goal_steps


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    a = 0.5 * lw.uniform(rng, -p.target_range, p.target_range)
    b = 0.5 * lw.uniform(rng, -p.target_range, p.target_range)
    # a turn about x, then one about the new y
    s.mocap_quat[p.target] = lw.quat(
        wp.cos(a) * wp.cos(b), wp.sin(a) * wp.cos(b), wp.cos(a) * wp.sin(b), wp.sin(a) * wp.sin(b)
    )


@lw.register
class AdroitPen(lw.Task):
    model = lw.gymnasium_robotics_model("adroit_hand/adroit_pen.xml")
    gymnasium = "AdroitHandPen-v1"
    frame_skip = 5
    obs = {
        "joints": 24,
        "position": 3,
        "velocity": 6,
        "axis": 3,
        "target_axis": 3,
        "position_error": 3,
        "axis_error": 3,
    }
    horizon = 200
    lagged = ("xpos", "site_xpos")
    memory = 1
    action_range = (-1.0, 1.0)
    planning = lw.Planning(settings={"horizon": 32, "samples": 160, "temperature": 1.0, "noise": 1.0})  # the paper's

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Let the target be turned in each world and touch nothing, and pair fingertips once."""
        target = spec.body("target")
        target.mocap = True
        for geom in target.geoms:
            geom.contype = geom.conaffinity = 0
        tips = ("C_rfdistal", "C_lfdistal")
        for pair in [pair for pair in spec.pairs if (pair.geomname1, pair.geomname2) == tips][1:]:
            spec.delete(pair)  # else the C engine would count a contact of theirs twice, and MuJoCo Warp once
