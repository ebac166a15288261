"""WalkerStand: a planar walker stands up."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    xpos: Row[wp.vec3]
    xmat: Row[wp.mat33]
    subtree_linvel: Row[wp.vec3]


@wp.struct
class Params(suite.RandomJoints):
    stand_height: float = 1.2  # m
    move_speed: float = 0.0  # m/s
    torso: int = lw.body("torso")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = int(0)
    for i in range(1, s.xmat.shape[0]):
        k = lw.put(obs, k, wp.vec2(s.xmat[i][0, 0], s.xmat[i][0, 2]))
    k = lw.put(obs, k, s.xpos[p.torso][2])
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    standing = lw.tolerance(s1.xpos[p.torso][2], wp.vec2(p.stand_height, wp.inf), p.stand_height / 2.0)
    upright = (1.0 + s1.xmat[p.torso][2, 2]) / 2.0
    stand = (3.0 * standing + upright) / 4.0
    if p.move_speed == 0.0:
        return stand
    speed, fast = s1.subtree_linvel[p.torso][0], wp.vec2(p.move_speed, wp.inf)
    move = lw.tolerance(speed, fast, p.move_speed / 2.0, lw.Sigmoid.LINEAR, 0.5)
    return stand * (5.0 * move + 1.0) / 6.0


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    suite.draw_joints(s.qpos, p.drawn_joints, p.drawn_range, rng)


@lw.register
class WalkerStand(lw.Task):
    model, frame_skip = suite.model("walker"), 10
    obs = {"orientations": 14, "height": 1, "velocity": 9}


@lw.register
class WalkerWalk(WalkerStand):
    """A planar walker walks at 1 m/s."""

    params = {"move_speed": 1.0}


@lw.register
class WalkerRun(WalkerStand):
    """A planar walker runs at up to 8 m/s."""

    params = {"move_speed": 8.0}
