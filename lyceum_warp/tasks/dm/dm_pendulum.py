"""PendulumSwingup: swing a pendulum up with a weak motor."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]


@wp.struct
class Params:
    largest_angle: float = 8.0  # from upright, degrees


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, wp.cos(s.qpos[0]))
    k = lw.put(obs, k, wp.sin(s.qpos[0]))
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return lw.tolerance(wp.cos(s1.qpos[0]), wp.vec2(wp.cos(wp.radians(p.largest_angle)), 1.0))


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[0] = lw.uniform(rng, -wp.pi, wp.pi)


@lw.register
class PendulumSwingup(lw.Task):
    model, frame_skip = suite.model("pendulum"), 1
    obs = {"orientation": 2, "velocity": 1}
