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
    k = lw.put(obs, 0, s.qpos, int(p.exclude_current_positions_from_observation), 9)
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    forward = p.forward_reward_weight * (s1.qpos[0] - s0.qpos[0]) / p.dt
    return forward - p.ctrl_cost_weight * lw.sum_squares(action)


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
    model, frame_skip, gymnasium = "half_cheetah.xml", 5, "HalfCheetah-v5"
    obs = staticmethod(lambda p: {"position": 9 - p.exclude_current_positions_from_observation, "velocity": 9})
    planning = lw.Planning(settings={"temperature": 1.0, "noise": 0.5, "smoothing": (1.0, 0.0, 0.0)})
