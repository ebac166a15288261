"""Define a task with metrics and observation groups: a ball that must stay on a rail."""

import warp as wp
from rail_task import rail

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]


@wp.struct
class Params:
    dt: float
    far: float = 1.0


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]


@wp.func
def observe_critic(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.qvel[0]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return s1.qpos[0] - s0.qpos[0] - 0.1 * action[0] * action[0]


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    metrics[0] = s1.qpos[0] - s0.qpos[0]
    metrics[1] = action[0] * action[0]


@wp.func
def terminated(s: World, p: Params) -> bool:
    return wp.abs(s.qpos[0]) > p.far


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qvel[0] = lw.uniform(rng, -4.0, 4.0)


class Metered(lw.Task):
    model = staticmethod(rail)
    frame_skip = 5
    obs = {"policy": {"x": 1}, "critic": {"x": 1, "v": 1}}
    metrics = ("forward", "effort")
    horizon = 40
