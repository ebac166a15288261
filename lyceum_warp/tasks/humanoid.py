"""Humanoid: walk forward on two legs without falling over (Gymnasium's Humanoid-v5).

MuJoCo's sensor stage computes the contact forces. With the model's integrator RK4, that stage runs only in the first of
four passes of a substep. Gymnasium computes ``cfrc_ext`` again after the last pass. The task's contact forces therefore
differ from Gymnasium's while feet touch the ground. The solver is Newton instead of the model's PGS.
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
    subtree_com: Row[wp.vec3]
    cinert: Row[lw.vec10]
    cvel: Row[wp.spatial_vector]
    qfrc_actuator: Row[float]
    cfrc_ext: Row[wp.spatial_vector]


@wp.struct
class Params:
    dt: float
    forward_reward_weight: float = 1.25
    ctrl_cost_weight: float = 0.1
    contact_cost_weight: float = 5e-7
    contact_cost_range: wp.vec2 = wp.vec2(-wp.inf, 10.0)
    healthy_reward: float = 5.0
    terminate_when_unhealthy: bool = True
    healthy_z_range: wp.vec2 = wp.vec2(1.0, 2.0)
    reset_noise_scale: float = 1e-2
    exclude_current_positions_from_observation: bool = True
    include_cinert_in_observation: bool = True
    include_cvel_in_observation: bool = True
    include_qfrc_actuator_in_observation: bool = True
    include_cfrc_ext_in_observation: bool = True


@wp.func
def healthy(s: World, p: Params) -> bool:
    return lw.inside(s.qpos[2], p.healthy_z_range)


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 2 * int(p.exclude_current_positions_from_observation), 24)
    k = lw.put(obs, k, s.qvel)
    if p.include_cinert_in_observation:
        k = lw.put(obs, k, s.cinert, 1, 14)
    if p.include_cvel_in_observation:
        k = lw.put(obs, k, s.cvel, 1, 14)
    if p.include_qfrc_actuator_in_observation:
        k = lw.put(obs, k, s.qfrc_actuator, 6, 23)
    if p.include_cfrc_ext_in_observation:
        lw.put(obs, k, s.cfrc_ext, 1, 14)


@wp.func
def contact_cost(s: World, p: Params) -> float:
    cost = p.contact_cost_weight * lw.sum_squares(s.cfrc_ext)
    return wp.clamp(cost, p.contact_cost_range[0], p.contact_cost_range[1])


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    # the world body's subtree contains the whole robot
    forward = p.forward_reward_weight * (s1.subtree_com[0][0] - s0.subtree_com[0][0]) / p.dt
    alive = wp.where(healthy(s1, p), p.healthy_reward, 0.0)
    return forward + alive - p.ctrl_cost_weight * lw.sum_squares(action) - contact_cost(s1, p)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.qpos[0]


@wp.func
def terminated(s: World, p: Params) -> bool:
    return p.terminate_when_unhealthy and not healthy(s, p)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(24):
        s.qpos[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
    for i in range(23):
        s.qvel[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)


@lw.register
class Humanoid(lw.Task):
    model, frame_skip, gymnasium = "humanoid.xml", 5, "Humanoid-v5"
    # one implicitfast substep is 13 times faster than five RK4 substeps; plans with it reach 92 to 103 % of the return
    # of plans with RK4
    physics = {"fast": lw.PhysicsOptions(integrator="implicitfast", timestep=0.015, frame_skip=1)}
    planning = lw.Planning(options={"physics": "fast"})
    lagged = ("subtree_com", "cinert", "cvel")

    @staticmethod
    def obs(p: Params) -> dict[str, int]:
        return {
            "position": 24 - 2 * p.exclude_current_positions_from_observation,
            "velocity": 23,
            "inertia": 130 * p.include_cinert_in_observation,
            "body_velocity": 78 * p.include_cvel_in_observation,
            "actuator_force": 17 * p.include_qfrc_actuator_in_observation,
            "contact_force": 78 * p.include_cfrc_ext_in_observation,
        }

    @staticmethod
    def mirror(model: mujoco.MjModel, p: Any) -> lw.Mirror:
        # the waist's three joints, the right and the left leg, the right and the left arm
        limbs = [7, 8, 9, 10, 3, 4, 5, 6, 14, 15, 16, 11, 12, 13], [*[1] * 8, *[-1, -1, 1] * 2]
        joints = np.array([0, 1, 2, *limbs[0]]), [-1, 1, -1, *limbs[1]]
        bodies = np.array([0, 1, 2, 6, 7, 8, 3, 4, 5, 11, 12, 9, 10])
        base = [1, -1, 1, 1, -1, 1, -1][2 * p.exclude_current_positions_from_observation :]
        spatial = ([6 * i + k for i in bodies for k in range(6)], [-1, 1, -1, 1, -1, 1] * 13)
        return lw.Mirror({
            "position": ([*range(len(base)), *len(base) + joints[0]], [*base, *joints[1]]),
            "velocity": ([*range(6), *6 + joints[0]], [1, -1, 1, -1, 1, -1, *joints[1]]),
            # moments and products of inertia (xx, yy, zz, xy, xz, yz), mass times position, and mass
            "inertia": ([10 * i + k for i in bodies for k in range(10)], [1, 1, 1, -1, 1, -1, 1, -1, 1, 1] * 13),
            "body_velocity": spatial,
            "actuator_force": joints,
            "contact_force": spatial,
            "action": (joints[0], [1, -1, -1, *limbs[1]]),  # the order of the waist's controls is y, z, x
        })  # fmt: skip
