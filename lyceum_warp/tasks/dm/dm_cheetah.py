"""CheetahRun: a planar cheetah runs at up to 10 m/s."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    subtree_linvel: Row[wp.vec3]


@wp.struct
class Params(suite.RandomJoints):
    run_speed: float = 10.0  # m/s
    torso: int = lw.body("torso")
    drawn_joints: wp.array[int] = lw.from_model(lambda model, p: model.jnt_qposadr[model.jnt_limited == 1])


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 1, s.qpos.shape[0])
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    speed, fast = s1.subtree_linvel[p.torso][0], wp.vec2(p.run_speed, wp.inf)
    return lw.tolerance(speed, fast, p.run_speed, lw.Sigmoid.LINEAR, 0.0)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    suite.draw_joints(s.qpos, p.drawn_joints, p.drawn_range, rng)


@lw.register
class CheetahRun(lw.Task):
    model, frame_skip, settle = suite.model("cheetah"), 1, 200
    obs = {"position": 8, "velocity": 9}

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Scale the densities to the total mass in the MJCF, because ``settotalmass`` is deprecated."""
        mass, spec.compiler.settotalmass = spec.compiler.settotalmass, -1.0
        scale = mass / spec.copy().compile().body_subtreemass[0]
        for geom in spec.geoms:
            geom.density *= scale
