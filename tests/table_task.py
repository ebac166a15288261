"""Define a task that reads a motion from an array parameter: a ball on a rail follows the motion."""

import warp as wp
from rail_task import rail

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    time: float


@wp.struct
class Params:
    dt: float
    gain: float = 1.0
    motion: wp.array2d[float] = [[0.0, 1.0], [0.5, 2.0], [1.0, 3.0]]
    points: wp.array[wp.vec3] = [(1.0, 2.0, 3.0)]


@wp.func
def frame(s: World, p: Params) -> int:
    return wp.min(int(s.time / p.dt + 0.5), p.motion.shape[0] - 1)


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = p.motion[frame(s, p), 0]
    obs[2] = p.motion[frame(s, p)][1]
    obs[3] = p.points[0][2]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return -p.gain * wp.abs(s1.qpos[0] - p.motion[frame(s1, p), 0])


@wp.func
def initialize(s: World, p: Params):
    s.qpos[0] = p.motion[0, 0]
    s.qvel[0] = p.motion[0, 1]


class Follow(lw.Task):
    model = staticmethod(rail)
    obs = {"x": 1, "reference": 2, "height": 1}
    horizon = 8
