"""PointMass: push a point onto a target in the plane (Lyceum's PointMass)."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # agent x, y, target x, y
    qvel: Row[float]


@wp.struct
class Params:
    success_distance: float = 0.05


@wp.func
def distance(s: World) -> float:
    return wp.length(wp.vec2(s.qpos[0] - s.qpos[2], s.qpos[1] - s.qpos[3]))


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 0, 2)
    k = lw.put(obs, k, s.qvel, 0, 2)
    lw.put(obs, k, s.qpos, 2, 4)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return 1.0 - distance(s1)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return distance(s)


@wp.func
def success(s: World, p: Params) -> bool:
    return distance(s) < p.success_distance


@wp.func
def initialize(s: World, p: Params):
    s.qpos[2] = 1.0


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(4):
        s.qpos[i] = lw.uniform(rng, -1.0, 1.0)


@lw.register
class PointMass(lw.Task):
    model = "point_mass.xml"
    obs = {"position": 2, "velocity": 2, "target": 2}
    horizon = 256
    mirror = lw.Mirror({**dict.fromkeys(("position", "velocity", "target"), (1, -1)), "x": (1,), "y": (-1,)})
