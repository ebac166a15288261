"""Define a task with terms: a ball on a rail with rewards for its speed and its position."""

from typing import Any

import warp as wp
from rail_task import rail

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    pushes: Row[float] = lw.memory()


@wp.struct
class Params:
    dt: float
    target: float = 0.3
    border: float = 0.4


@wp.func
def place(s: World) -> float:
    return s.qpos[0]


@wp.func
def distance(place: float, target: float) -> float:
    return wp.abs(place - target)


@wp.func
def fast(qvel: Row[float], scale: float = 2.0) -> float:  # takes a field of World, and an argument with a default
    return scale * wp.abs(qvel[0])


@wp.func
def near(distance: float) -> float:
    return wp.exp(-distance)


@wp.func
def effort(action: Row[float]) -> float:
    total = float(0.0)
    for i in range(action.shape[0]):
        total += action[i] * action[i]
    return total


@wp.func
def pushed(s: World) -> float:
    return s.pushes[0]


@wp.func
def change(s0: World, s1: World, p: Params) -> float:
    return (pushed(s1) - pushed(s0)) * p.target


@wp.func
def outside(place: float, border: float) -> bool:
    return wp.abs(place) > border


@wp.func
def too_fast(s: Any) -> bool:  # this function works with the World of any task
    return wp.abs(s.qvel[0]) > 3.0


@wp.func
def too_fast_before(s0: World) -> bool:
    return too_fast(s0)


@wp.func
def arrived(place: float, target: float, qvel: Row[float]) -> bool:
    return wp.abs(place - target) < 0.02 and qvel[0] > 0.0


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[0] = lw.uniform(rng, -0.3, 0.3)


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.pushes[0] = s0.pushes[0] + action[0]


class Terms(lw.Task):
    model = staticmethod(lambda: rail(gear=300.0))
    obs = {"x": 1}
    rewards = {"near": 1, "fast": 0.5, "effort": -0.1, "change": 0.25}
    terminations = ("outside", "too_fast")
    truncations = ("arrived",)
    metrics = ("distance", "too_fast_before")
    horizon = 50
