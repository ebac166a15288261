"""Swimmer: swim forward through a viscous fluid (Gymnasium's Swimmer-v5), with the reward of the task half_cheetah."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.half_cheetah import HalfCheetah, Params, World


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 2 * int(p.exclude_current_positions_from_observation), 5)
    lw.put(obs, k, s.qvel)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(5):
        s.qpos[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
        s.qvel[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)


@lw.register
class Swimmer(HalfCheetah):
    model, frame_skip, gymnasium = "swimmer.xml", 4, "Swimmer-v5"
    obs = staticmethod(lambda p: {"position": 5 - 2 * p.exclude_current_positions_from_observation, "velocity": 5})
    params = {"ctrl_cost_weight": 1e-4}
    planning = lw.Planning()
    # With smaller discounts, some policies stay at a return of about 130 (Franceschetti et al. 2022, arXiv:2208.07587).
    training = lw.Training(settings={"gamma": 0.9999})
