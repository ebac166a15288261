"""InvertedDoublePendulum: keep a pole of two links upright on a cart (Gymnasium's InvertedDoublePendulum-v5).

As in Gymnasium, the tip's position and the constraint force on the cart are one substep old after ``mj_step``.
The force is zero except at the ends of the rail.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # the cart's position (m), the angles of the lower and the upper link (rad)
    qvel: Row[float]
    site_xpos: Row[wp.vec3]
    qfrc_constraint: Row[float]


@wp.struct
class Params:
    healthy_reward: float = 10.0
    reset_noise_scale: float = 0.1
    tip: int = lw.site("tip")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    for i in range(2):
        obs[1 + i] = wp.sin(s.qpos[1 + i])
        obs[3 + i] = wp.cos(s.qpos[1 + i])
    for i in range(3):
        obs[5 + i] = wp.clamp(s.qvel[i], -10.0, 10.0)
    obs[8] = wp.clamp(s.qfrc_constraint[0], -10.0, 10.0)


@wp.func
def terminated(s: World, p: Params) -> bool:
    return s.site_xpos[p.tip][2] <= 1.0


@wp.func
def terms(s1: World, p: Params) -> wp.vec3:
    x, below = s1.site_xpos[p.tip][0], s1.site_xpos[p.tip][2] - 2.0
    alive = wp.where(terminated(s1, p), 0.0, p.healthy_reward)
    distance = 0.01 * x * x + below * below
    velocity = 1e-3 * s1.qvel[1] * s1.qvel[1] + 5e-3 * s1.qvel[2] * s1.qvel[2]
    return wp.vec3(alive, -distance, -velocity)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.dot(terms(s1, p), wp.vec3(1.0))


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.site_xpos[p.tip][2]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(3):
        s.qpos[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
        s.qvel[i] += p.reset_noise_scale * lw.normal(rng)


@lw.register
class InvertedDoublePendulum(lw.Task):
    model, frame_skip, gymnasium = "inverted_double_pendulum.xml", 5, "InvertedDoublePendulum-v5"
    obs = {"position": 1, "sines": 2, "cosines": 2, "velocity": 3, "constraint_force": 1}
    metrics = ("reward_survive", "distance_penalty", "velocity_penalty")
    lagged = ("site_xpos",)
