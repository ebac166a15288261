"""Hopper: hop forward on one leg (Gymnasium's Hopper-v5)."""

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
    ctrl_cost_weight: float = 1e-3
    healthy_reward: float = 1.0
    terminate_when_unhealthy: bool = True
    healthy_state_range: wp.vec2 = wp.vec2(-100.0, 100.0)
    healthy_z_range: wp.vec2 = wp.vec2(0.7, wp.inf)
    healthy_angle_range: wp.vec2 = wp.vec2(-0.2, 0.2)
    reset_noise_scale: float = 5e-3
    exclude_current_positions_from_observation: bool = True


@wp.func
def healthy(s: World, p: Params) -> bool:
    ok = lw.inside(s.qpos[1], p.healthy_z_range) and lw.inside(s.qpos[2], p.healthy_angle_range)
    ok = ok and lw.all_inside(s.qpos, 2, s.qpos.shape[0], p.healthy_state_range)
    return ok and lw.all_inside(s.qvel, 0, s.qvel.shape[0], p.healthy_state_range)


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, int(p.exclude_current_positions_from_observation), s.qpos.shape[0])
    for i in range(s.qvel.shape[0]):
        obs[k + i] = wp.clamp(s.qvel[i], -10.0, 10.0)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    forward = p.forward_reward_weight * (s1.qpos[0] - s0.qpos[0]) / p.dt
    alive = wp.where(healthy(s1, p), p.healthy_reward, 0.0)
    return forward + alive - p.ctrl_cost_weight * lw.sum_squares(action)


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.qpos[0]


@wp.func
def terminated(s: World, p: Params) -> bool:
    return p.terminate_when_unhealthy and not healthy(s, p)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(s.qpos.shape[0]):
        s.qpos[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)
        s.qvel[i] += lw.uniform(rng, -p.reset_noise_scale, p.reset_noise_scale)


@lw.register
class Hopper(lw.Task):
    model, frame_skip, gymnasium = "hopper.xml", 4, "Hopper-v5"
    obs = staticmethod(lambda p: {"position": 6 - p.exclude_current_positions_from_observation, "velocity": 6})
    # Euler's method is 3 to 4 times faster than RK4, and returns differ by up to 2 %
    physics = {"fast": lw.PhysicsOptions(integrator="euler")}
    # with a short horizon, planners need a higher healthy_reward to keep the robot from falling
    planning = lw.Planning(
        settings={"horizon": 128, "samples": 128, "noise": 0.1},
        options={"integrator": "euler"},
        params={"healthy_reward": 2.0, "forward_reward_weight": 0.2},
    )
