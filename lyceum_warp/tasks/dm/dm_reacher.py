"""ReacherEasy: touch a large target with the finger of a planar arm."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    geom_xpos: Row[wp.vec3]
    mocap_pos: Row[wp.vec3]


@wp.struct
class Params(suite.RandomJoints):
    finger: int = lw.geom("finger")
    target: int = lw.mocap("target")
    radii: float = lw.from_model(lambda model, p: model.geom("target").size[0] + model.geom_size[p.finger, 0])  # m


@wp.func
def finger_to_target(s: World, p: Params) -> wp.vec2:
    v = s.mocap_pos[p.target] - s.geom_xpos[p.finger]
    return wp.vec2(v[0], v[1])


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos)
    k = lw.put(obs, k, finger_to_target(s, p))
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return lw.tolerance(wp.length(finger_to_target(s1, p)), wp.vec2(0.0, p.radii))


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    suite.draw_joints(s.qpos, p.drawn_joints, p.drawn_range, rng)
    angle, radius = lw.uniform(rng, 0.0, 2.0 * wp.pi), lw.uniform(rng, 0.05, 0.2)
    s.mocap_pos[p.target][0] = radius * wp.sin(angle)
    s.mocap_pos[p.target][1] = radius * wp.cos(angle)


@lw.register
class ReacherEasy(lw.Task):
    model, frame_skip = suite.model("reacher"), 1
    obs = {"position": 2, "to_target": 2, "velocity": 2}
    target_radius = 0.05  # m

    @classmethod
    def edit_model(cls, spec: mujoco.MjSpec) -> None:
        suite.free_target(spec)
        spec.geom("target").size[0] = cls.target_radius


@lw.register
class ReacherHard(ReacherEasy):
    """Touch a small target with the finger of a planar arm."""

    target_radius = 0.015
