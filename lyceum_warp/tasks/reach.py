"""Reach: move the hand of a 7-joint arm to a target in space (the arm that the Lyceum paper calls Sawyer).

The model has no gravity. Success: the hand's mean distance from the target over the last ten steps is below 5 cm. With
``random_start``, one episode in five begins with the palm inside the table, and contact forces push it out.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

REMEMBERED = 10
"""The distance is averaged over this number of steps."""
FAR = 10.0
"""Initial value of the remembered distances, m. It makes success impossible before the tenth step."""


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    site_xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]
    jnt_range: Row[wp.vec2]
    distances: Row[float] = lw.memory(REMEMBERED)  # distances in m, from the oldest to the latest


@wp.struct
class Params:
    success_distance: float = 0.05
    random_start: bool = False  # initial joints are random in the paper's text, zero in its code
    target_range: wp.vec3 = wp.vec3(0.3, 0.2, 0.25)
    finger: int = lw.site("finger")
    target: int = lw.mocap("target")


@wp.func
def error(s: World, p: Params) -> wp.vec3:
    return s.site_xpos[p.finger] - s.mocap_pos[p.target]


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos)
    k = lw.put(obs, k, s.qvel)
    k = lw.put(obs, k, s.site_xpos[p.finger])
    lw.put(obs, k, error(s, p))


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    e = error(s1, p)
    return -(wp.abs(e[0]) + wp.abs(e[1]) + wp.abs(e[2])) - 5.0 * wp.length(e)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.length(error(s, p))


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    for i in range(REMEMBERED - 1):
        s1.distances[i] = s0.distances[i + 1]
    s1.distances[REMEMBERED - 1] = wp.length(error(s1, p))


@wp.func
def success(s: World, p: Params) -> bool:
    total = float(0.0)
    for i in range(REMEMBERED):
        total += s.distances[i]
    return total / float(REMEMBERED) < p.success_distance


@wp.func
def initialize(s: World, p: Params):
    for i in range(REMEMBERED):
        s.distances[i] = FAR


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.mocap_pos[p.target] = lw.uniform(rng, -p.target_range, p.target_range)
    if p.random_start:
        for i in range(7):
            s.qpos[i] = lw.uniform(rng, s.jnt_range[i][0], s.jnt_range[i][1])


@lw.register
class Reach(lw.Task):
    model = "reach.xml"
    frame_skip = 2
    obs = {"position": 7, "velocity": 7, "hand": 3, "error": 3}
    horizon = 75
    # one long substep is 1.7 times faster than two short ones, and returns differ by up to 0.2 %
    physics = {"fast": lw.PhysicsOptions(frame_skip=1, timestep=0.02)}
    # the paper's settings, including an inverse temperature of 5
    planning = lw.Planning(settings={"horizon": 16, "samples": 30, "temperature": 0.2, "noise": 1.0})
