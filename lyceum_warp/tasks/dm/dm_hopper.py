"""HopperStand: a planar hopper stands on its foot."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    xipos: Row[wp.vec3]
    subtree_linvel: Row[wp.vec3]
    sensordata: Row[float]


@wp.struct
class Params(suite.RandomJoints):
    stand_height: float = 0.6  # torso above foot, m
    hop_speed: float = 0.0  # m/s
    torso: int = lw.body("torso")
    foot: int = lw.body("foot")
    toe: int = lw.sensor("touch_toe")
    heel: int = lw.sensor("touch_heel")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 1, s.qpos.shape[0])
    k = lw.put(obs, k, s.qvel)
    lw.put(obs, k, wp.vec2(suite.log1p(s.sensordata[p.toe]), suite.log1p(s.sensordata[p.heel])))


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    standing = lw.tolerance(s1.xipos[p.torso][2] - s1.xipos[p.foot][2], wp.vec2(p.stand_height, 2.0))
    if p.hop_speed == 0.0:
        return standing * suite.small_control(action)
    speed, fast = s1.subtree_linvel[p.torso][0], wp.vec2(p.hop_speed, wp.inf)
    return standing * lw.tolerance(speed, fast, p.hop_speed / 2.0, lw.Sigmoid.LINEAR, 0.5)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    suite.draw_joints(s.qpos, p.drawn_joints, p.drawn_range, rng)


@lw.register
class HopperStand(lw.Task):
    model, frame_skip = suite.model("hopper"), 4
    obs = {"position": 6, "velocity": 7, "touch": 2}


@lw.register
class HopperHop(HopperStand):
    """A planar hopper hops at 2 m/s."""

    params = {"hop_speed": 2.0}
