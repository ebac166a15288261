"""CartpoleSwingup: swing a pole up and balance it (dm_control's cartpole swingup, with Lyceum's reward).

All sigmoids of Lyceum's reward are quadratic. In dm_control's reward, only the control's sigmoid is quadratic, and the
others are Gaussian. Episodes do not terminate.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]  # cart, pole
    qvel: Row[float]


@wp.struct
class Params:
    reset_noise_scale: float = 0.01


@wp.func
def near_zero(x: float, margin: float, value_at_margin: float) -> float:
    return lw.tolerance(x, wp.vec2(0.0), margin, lw.Sigmoid.QUADRATIC, value_at_margin)


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos[0])
    k = lw.put(obs, k, wp.cos(s.qpos[1]))
    k = lw.put(obs, k, wp.sin(s.qpos[1]))
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    upright = (1.0 + wp.cos(s1.qpos[1])) / 2.0
    centred = (1.0 + near_zero(s1.qpos[0], 2.0, 0.1)) / 2.0
    small_control = (4.0 + near_zero(action[0], 1.0, 0.0)) / 5.0
    small_velocity = (1.0 + near_zero(s1.qvel[1], 5.0, 0.1)) / 2.0
    return upright * centred * small_control * small_velocity


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.cos(s.qpos[1])


@wp.func
def initialize(s: World, p: Params):
    s.qpos[1] = wp.pi


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(2):
        s.qpos[i] += p.reset_noise_scale * lw.normal(rng)
        s.qvel[i] += p.reset_noise_scale * lw.normal(rng)


@lw.register
class CartpoleSwingup(lw.Task):
    model = "cartpole.xml"
    obs = {"cart_position": 1, "pole_direction": 2, "cart_velocity": 1, "pole_velocity": 1}
    # Euler's method is 2.6 times as fast as RK4, and returns differ by up to 2 %
    physics = {"fast": lw.PhysicsOptions(integrator="euler")}
    planning = lw.Planning(settings={"horizon": 100})
