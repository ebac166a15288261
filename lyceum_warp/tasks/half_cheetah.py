"""HalfCheetah: run forward (Gymnasium's HalfCheetah-v5)."""

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
    forward_reward_weight: float = 1.0
    ctrl_cost_weight: float = 0.1
    reset_noise_scale: float = 0.1
    exclude_current_positions_from_observation: bool = True


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    skip = int(p.exclude_current_positions_from_observation)
    for i in range(skip, 9):
        obs[i - skip] = s.qpos[i]
    for i in range(9):
        obs[9 - skip + i] = s.qvel[i]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    r = p.forward_reward_weight * (s1.qpos[0] - s0.qpos[0]) / p.dt
    for i in range(6):
        r -= p.ctrl_cost_weight * action[i] * action[i]
    return r


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.qpos[0]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(9):
        s.qpos[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
        s.qvel[i] += p.reset_noise_scale * lw.normal(rng)


@lw.register
class HalfCheetah(lw.Task):
    model = "half_cheetah.xml"
    frame_skip = 5
    obs = staticmethod(lambda p: {"position": 9 - p.exclude_current_positions_from_observation, "velocity": 9})
    planning = lw.Planning(settings={"temperature": 1.0, "noise": 0.5, "smoothing": (1.0, 0.0, 0.0)})
