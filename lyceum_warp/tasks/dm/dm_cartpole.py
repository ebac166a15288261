"""CartpoleBalance: balance a pole on a cart, in the middle of its rail."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]  # cart, pole
    qvel: Row[float]


@wp.struct
class Params:
    swing_up: bool = False  # whether the pole starts hanging
    sparse: bool = False  # whether only upright states near the centre are rewarded


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, wp.vec3(s.qpos[0], wp.cos(s.qpos[1]), wp.sin(s.qpos[1])))
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    position, cosine = s1.qpos[0], wp.cos(s1.qpos[1])
    if p.sparse:
        return lw.tolerance(position, wp.vec2(-0.25, 0.25)) * lw.tolerance(cosine, wp.vec2(0.995, 1.0))
    upright = (1.0 + cosine) / 2.0
    centered = (1.0 + lw.tolerance(position, wp.vec2(0.0), 2.0)) / 2.0
    small_velocity = (1.0 + lw.tolerance(s1.qvel[1], wp.vec2(0.0), 5.0)) / 2.0
    return upright * suite.small_control(action) * small_velocity * centered


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    if p.swing_up:
        s.qpos[0] = 0.01 * lw.normal(rng)
        s.qpos[1] = wp.pi + 0.01 * lw.normal(rng)
    else:
        s.qpos[0] = lw.uniform(rng, -0.1, 0.1)
        s.qpos[1] = lw.uniform(rng, -0.034, 0.034)
    for i in range(2):
        s.qvel[i] = 0.01 * lw.normal(rng)


@lw.register
class CartpoleBalance(lw.Task):
    model, frame_skip = suite.model("cartpole"), 1
    obs = {"position": 3, "velocity": 2}


@lw.register
class CartpoleBalanceSparse(CartpoleBalance):
    """Balance a pole on a cart. The reward is 1 near the goal and 0 elsewhere."""

    params = {"sparse": True}


@lw.register
class CartpoleSwingup(CartpoleBalance):
    """Swing up a pole on a cart, and balance it."""

    params = {"swing_up": True}
    planning = lw.Planning(settings={"horizon": 50}, options={"timestep": 0.02, "integrator": "euler"})


@lw.register
class CartpoleSwingupSparse(CartpoleBalance):
    """Swing up a pole on a cart. The reward is 1 near the goal and 0 elsewhere."""

    params = {"swing_up": True, "sparse": True}
