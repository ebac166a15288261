"""HumanoidStandup: stand up from the floor (Gymnasium's HumanoidStandup-v5).

MuJoCo's sensor stage computes the contact forces, as in the task humanoid. The first observation of an episode contains
contact forces. In Gymnasium, they are zero. The solver is Newton instead of the model's PGS. ``uph_cost_weight`` is the
weight of the height. Gymnasium documents this parameter but does not use it.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.humanoid import Humanoid


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    cinert: Row[lw.vec10]
    cvel: Row[wp.spatial_vector]
    qfrc_actuator: Row[float]
    cfrc_ext: Row[wp.spatial_vector]


@wp.struct
class Params:
    substep_dt: float
    uph_cost_weight: float = 1.0
    ctrl_cost_weight: float = 0.1
    impact_cost_weight: float = 5e-7
    impact_cost_range: wp.vec2 = wp.vec2(-wp.inf, 10.0)
    reset_noise_scale: float = 1e-2
    exclude_current_positions_from_observation: bool = True
    include_cinert_in_observation: bool = True
    include_cvel_in_observation: bool = True
    include_qfrc_actuator_in_observation: bool = True
    include_cfrc_ext_in_observation: bool = True


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
def terms(action: Row[float], s1: World, p: Params) -> wp.vec3:
    # as in Gymnasium, the torso's height, not its change, is divided by the duration of a substep
    height = p.uph_cost_weight * s1.qpos[2] / p.substep_dt
    impact = p.impact_cost_weight * lw.sum_squares(s1.cfrc_ext)
    impact = wp.clamp(impact, p.impact_cost_range[0], p.impact_cost_range[1])
    return wp.vec3(height, -p.ctrl_cost_weight * lw.sum_squares(action), -impact)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return wp.dot(terms(action, s1, p), wp.vec3(1.0)) + 1.0


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    lw.put(metrics, 0, terms(action, s1, p))


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.qpos[2]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(24):
        s.qpos[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
    for i in range(23):
        s.qvel[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)


@lw.register
class HumanoidStandup(lw.Task):
    model, frame_skip, gymnasium = "humanoidstandup.xml", 5, "HumanoidStandup-v5"
    metrics = ("reward_linup", "reward_quadctrl", "reward_impact")
    lagged = ("cinert", "cvel")
    obs = staticmethod(Humanoid.obs)
