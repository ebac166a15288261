"""Cartpole: keep a pole upright on a cart in the middle of its rail (dm_control's cartpole balance).

The reward is dm_control's smooth reward. With ``sparse=True``, it is the reward of balance_sparse. Success: the pole is
upright and the cart is centred, as the sparse reward requires. Episodes do not terminate. In Gymnasium's CartPole-v1,
an episode ends if the pole tilts by 12 degrees, and there are only two actions.
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
    sparse: bool = False
    cart_range: wp.vec2 = wp.vec2(-0.25, 0.25)  # m, for balance
    cosine_range: wp.vec2 = wp.vec2(0.995, 1.0)  # bounds for the cosine of the pole's angle
    reset_cart: float = 0.1  # +-, m
    reset_pole: float = 0.034  # +-, rad
    reset_velocity: float = 0.01  # standard deviation, m/s or rad/s


@wp.func
def balanced(s: World, p: Params) -> bool:
    cart = lw.tolerance(s.qpos[0], p.cart_range)
    return cart * lw.tolerance(wp.cos(s.qpos[1]), p.cosine_range) == 1.0


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos[0])
    k = lw.put(obs, k, wp.cos(s.qpos[1]))
    k = lw.put(obs, k, wp.sin(s.qpos[1]))
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    if p.sparse:
        return float(balanced(s1, p))
    zero = wp.vec2(0.0)
    upright = (1.0 + wp.cos(s1.qpos[1])) / 2.0
    centred = (1.0 + lw.tolerance(s1.qpos[0], zero, margin=2.0)) / 2.0
    small_control = (4.0 + lw.tolerance(action[0], zero, 1.0, lw.Sigmoid.QUADRATIC, 0.0)) / 5.0
    small_velocity = (1.0 + lw.tolerance(s1.qvel[1], zero, margin=5.0)) / 2.0
    return upright * centred * small_control * small_velocity


@wp.func
def evaluate(s: World, p: Params) -> float:
    return wp.cos(s.qpos[1])


@wp.func
def success(s: World, p: Params) -> bool:
    return balanced(s, p)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[0] += lw.uniform(rng, -p.reset_cart, p.reset_cart)
    s.qpos[1] += lw.uniform(rng, -p.reset_pole, p.reset_pole)
    for i in range(2):
        s.qvel[i] += p.reset_velocity * lw.normal(rng)


@lw.register
class Cartpole(lw.Task):
    model = "cartpole.xml"
    obs = {"cart_position": 1, "pole_direction": 2, "cart_velocity": 1, "pole_velocity": 1}
    planning = lw.Planning(settings={"horizon": 50})
