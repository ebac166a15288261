import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]


@wp.struct
class Params:
    dt: float
    goal: wp.array[float] = [0.1, 0.2]


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.qvel[0]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return -wp.abs(s1.qpos[0] - p.goal[0])


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[0] = lw.uniform(rng, -1.0, 1.0)


class Slide(lw.Task):
    model, horizon, obs = "robot/scene.xml", 20, {"x": 1, "v": 1}
