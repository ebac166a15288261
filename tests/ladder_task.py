"""Define a task whose reward is its level: a cart that climbs one level an episode, and speed that all worlds share."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class Shared:
    bonus: Row[float] = lw.part()


@wp.struct
class Sums:
    steps: Row[float] = lw.part()


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    shared: Shared
    level: Row[float] = lw.lasting_memory()
    drawn: Row[float] = lw.lasting_memory()


@wp.struct
class Params:
    dt: float


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return s1.level[0] + s1.shared.bonus[0]


@wp.func
def height(level: Row[float]) -> float:
    return level[0]


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    s.drawn[0] = lw.uniform(rng, 0.0, 1.0)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[0] = lw.uniform(rng, -0.1, 0.1)


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.level[0] = s0.level[0] + 0.1


@wp.func
def tally(s0: World, action: Row[float], s1: World, p: Params, ended: bool, sums: Sums):
    sums.steps[0] = 1.0


@wp.func
def share(shared: Shared, sums: Sums, p: Params):
    shared.bonus[0] += 100.0


class Ladder(lw.Task):
    model, obs = "inverted_pendulum.xml", {"place": 1}
    frame_skip, horizon = 1, 10
    metrics = ("height",)
