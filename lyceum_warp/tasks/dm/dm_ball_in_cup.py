"""BallInCupCatch: swing a ball on a string into a cup."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]  # x and z of cup and ball
    qvel: Row[float]
    xpos: Row[wp.vec3]
    site_xpos: Row[wp.vec3]
    sensordata: Row[float]


@wp.struct
class Params:
    ball: int = lw.body("ball")
    target: int = lw.site("target")
    largest_offset: wp.vec3 = lw.from_model(lambda model, p: model.site_size[p.target] - model.geom("ball").size[0])
    contacts: int = lw.sensor("contacts")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos)
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    v = s1.site_xpos[p.target] - s1.xpos[p.ball]
    return wp.where(wp.abs(v[0]) < p.largest_offset[0] and wp.abs(v[2]) < p.largest_offset[2], 1.0, 0.0)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[2] = lw.uniform(rng, -0.2, 0.2)
    s.qpos[3] = lw.uniform(rng, 0.2, 0.5)


@wp.func
def reject(s: World, p: Params) -> bool:
    return s.sensordata[p.contacts] > 0.0


@lw.register
class BallInCupCatch(lw.Task):
    model, frame_skip = suite.model("ball_in_cup"), 10
    obs = {"position": 4, "velocity": 4}

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Add a sensor that counts contacts, so that ``reject`` can refuse initial states with contacts.

        Also add a keyframe with the ball in the cup. MuJoCo Warp's buffers get their sizes from simulations that start
        at each keyframe. Without this keyframe, the buffers would be too small.
        """
        suite.count_contacts(spec)
        spec.add_key(name="caught", qpos=[0.0, 0.0, 0.0, 0.333])
