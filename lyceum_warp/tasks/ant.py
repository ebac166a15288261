"""Ant: walk forward on four legs (Gymnasium's Ant-v5).

MuJoCo's sensor stage computes the contact forces. With the model's integrator RK4, that stage runs only in the first of
four passes of a substep. Gymnasium computes ``cfrc_ext`` again after the last pass. The model has pyramidal friction
cones. With pyramidal cones, MuJoCo Warp's contact frame differs from MuJoCo's for a steep leg on the floor. Both frames
are valid, but trajectories diverge. With ``cone="elliptic"``, both engines agree.
"""

from typing import Any

import mujoco
import numpy as np
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    xpos: Row[wp.vec3]
    cfrc_ext: Row[wp.spatial_vector]


@wp.struct
class Params:
    dt: float
    forward_reward_weight: float = 1.0
    ctrl_cost_weight: float = 0.5
    contact_cost_weight: float = 5e-4
    healthy_reward: float = 1.0
    main_body: int = lw.body("torso")  # the forward speed of this body is rewarded
    terminate_when_unhealthy: bool = True
    healthy_z_range: wp.vec2 = wp.vec2(0.2, 1.0)
    contact_force_range: wp.vec2 = wp.vec2(-1.0, 1.0)
    reset_noise_scale: float = 0.1
    exclude_current_positions_from_observation: bool = True
    include_cfrc_ext_in_observation: bool = True


@wp.func
def healthy(s: World, p: Params) -> bool:
    return p.healthy_z_range[0] <= s.qpos[2] and s.qpos[2] <= p.healthy_z_range[1]


@wp.func
def contact_force(s: World, p: Params, body: int) -> wp.spatial_vector:
    force = s.cfrc_ext[body]
    for i in range(6):
        force[i] = wp.clamp(force[i], p.contact_force_range[0], p.contact_force_range[1])
    return force


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 2 * int(p.exclude_current_positions_from_observation), 15)
    k = lw.put(obs, k, s.qvel)
    if p.include_cfrc_ext_in_observation:
        for body in range(1, 14):
            k = lw.put(obs, k, contact_force(s, p, body))


@wp.func
def terms(s0: World, action: Row[float], s1: World, p: Params) -> wp.vec4:
    forward = p.forward_reward_weight * (s1.xpos[p.main_body][0] - s0.xpos[p.main_body][0]) / p.dt
    contact = float(0.0)
    for body in range(14):
        contact += wp.length_sq(contact_force(s1, p, body))
    alive = wp.where(healthy(s1, p), p.healthy_reward, 0.0)
    return wp.vec4(forward, -p.ctrl_cost_weight * lw.sum_squares(action), -p.contact_cost_weight * contact, alive)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.dot(terms(s0, action, s1, p), wp.vec4(1.0))


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(s0, action, s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.qpos[0]


@wp.func
def terminated(s: World, p: Params) -> bool:
    return p.terminate_when_unhealthy and not healthy(s, p)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(15):
        s.qpos[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
    for i in range(14):
        s.qvel[i] += p.reset_noise_scale * lw.normal(rng)


@lw.register
class Ant(lw.Task):
    model, frame_skip, gymnasium = "ant.xml", 5, "Ant-v5"
    metrics = ("reward_forward", "reward_ctrl", "reward_contact", "reward_survive")
    lagged = ("xpos",)

    @staticmethod
    def obs(p: Params) -> dict[str, int]:
        return {
            "position": 15 - 2 * p.exclude_current_positions_from_observation,
            "velocity": 14,
            "contact_force": 78 * p.include_cfrc_ext_in_observation,
        }

    @staticmethod
    def mirror(model: mujoco.MjModel, p: Any) -> lw.Mirror:
        # of the legs 1 to 4, the mirror exchanges 1 with 4 and 2 with 3; each leg has a hip and an ankle
        joints = np.array([6, 7, 4, 5, 2, 3, 0, 1]), [-1, 1] * 4
        bodies = np.array([0, 10, 11, 12, 7, 8, 9, 4, 5, 6, 1, 2, 3])
        torso = [1, -1, 1, 1, -1, 1, -1][2 * p.exclude_current_positions_from_observation :]
        return lw.Mirror({
            "position": ([*range(len(torso)), *len(torso) + joints[0]], [*torso, *joints[1]]),
            "velocity": ([*range(6), *6 + joints[0]], [1, -1, 1, -1, 1, -1, *joints[1]]),
            "contact_force": ([6 * i + k for i in bodies for k in range(6)], [-1, 1, -1, 1, -1, 1] * 13),
            "action": ([2, 3, 0, 1, 6, 7, 4, 5], joints[1]),  # the first control acts on leg 4
        })  # fmt: skip
