"""Swimmer: swim forward through a viscous fluid (Gymnasium's Swimmer-v5)."""

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
    ctrl_cost_weight: float = 1e-4
    reset_noise_scale: float = 0.1
    exclude_current_positions_from_observation: bool = True


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 2 * int(p.exclude_current_positions_from_observation), 5)
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
    for i in range(5):
        s.qpos[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
        s.qvel[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)


@lw.register
class Swimmer(lw.Task):
    model, frame_skip, gymnasium = "swimmer.xml", 4, "Swimmer-v5"
    obs = staticmethod(lambda p: {"position": 5 - 2 * p.exclude_current_positions_from_observation, "velocity": 5})
    # With smaller discounts, some policies stay at a return of about 130 (Franceschetti et al. 2022, arXiv:2208.07587).
    training = lw.Training(settings={"gamma": 0.9999})
