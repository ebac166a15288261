"""InvertedPendulum: keep a pole upright on a cart (Gymnasium's InvertedPendulum-v5)."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # the cart's position (m), the pole's angle from upright (rad)
    qvel: Row[float]


@wp.struct
class Params:
    reset_noise_scale: float = 0.01


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos)
    lw.put(obs, k, s.qvel)


@wp.func
def terminated(s: World, p: Params) -> bool:
    return wp.abs(s.qpos[1]) > 0.2


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.where(terminated(s1, p), 0.0, 1.0)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.abs(s.qpos[1])


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(2):
        s.qpos[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
        s.qvel[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)


@lw.register
class InvertedPendulum(lw.Task):
    model, frame_skip, gymnasium = "inverted_pendulum.xml", 2, "InvertedPendulum-v5"
    obs = {"position": 2, "velocity": 2}
