"""FishUpright: a fish turns upright."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]  # a free joint and 7 hinges
    qvel: Row[float]
    xmat: Row[wp.mat33]


@wp.struct
class Params:
    torso: int = lw.body("torso")


@wp.func
def upright(s: World, p: Params) -> float:  # from -1 to 1
    return s.xmat[p.torso][2, 2]


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 7, s.qpos.shape[0])
    k = lw.put(obs, k, upright(s, p))
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return lw.tolerance(upright(s1, p), wp.vec2(1.0), 1.0)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    lw.put(s.qpos, 3, lw.quat_random(rng))
    for i in range(7, s.qpos.shape[0]):
        s.qpos[i] = lw.uniform(rng, -0.2, 0.2)


@lw.register
class FishUpright(lw.Task):
    model, frame_skip = suite.model("fish"), 10
    obs = {"joint_angles": 7, "upright": 1, "velocity": 13}

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Hide the target of FishSwim."""
        spec.geom("target").rgba[3] = 0.0


# swim


@wp.struct
class SwimWorld(World):
    geom_xpos: Row[wp.vec3]
    geom_xmat: Row[wp.mat33]
    mocap_pos: Row[wp.vec3]


@wp.struct
class SwimParams(Params):
    mouth: int = lw.geom("mouth")
    target: int = lw.mocap("target")
    radii: float = lw.from_model(lambda model, p: model.geom("target").size[0] + model.geom_size[p.mouth, 0])  # m


@wp.func
def mouth_to_target(s: SwimWorld, p: SwimParams) -> wp.vec3:  # in the mouth's axes
    return (s.mocap_pos[p.target] - s.geom_xpos[p.mouth]) * s.geom_xmat[p.mouth]


@wp.func
def observe_swim(s: SwimWorld, p: SwimParams, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos, 7, s.qpos.shape[0])
    k = lw.put(obs, k, upright(s, p))
    k = lw.put(obs, k, mouth_to_target(s, p))
    lw.put(obs, k, s.qvel)


@wp.func
def reward_swim(s0: SwimWorld, action: Row[float], s1: SwimWorld, p: SwimParams) -> float:
    in_target = lw.tolerance(wp.length(mouth_to_target(s1, p)), wp.vec2(0.0, p.radii), 2.0 * p.radii)
    return (7.0 * in_target + (upright(s1, p) + 1.0) / 2.0) / 8.0


@wp.func
def randomize_swim(s: SwimWorld, p: SwimParams, rng: Row[wp.uint32]):
    randomize(s, p, rng)
    s.mocap_pos[p.target] = lw.uniform(rng, wp.vec3(-0.4, -0.4, 0.1), wp.vec3(0.4, 0.4, 0.3))


@lw.register
class FishSwim(lw.Task):
    """A fish swims to a target."""

    model, frame_skip = suite.model("fish"), 10
    World, Params = SwimWorld, SwimParams
    observe, reward, randomize = observe_swim, reward_swim, randomize_swim
    obs = {"joint_angles": 7, "upright": 1, "target": 3, "velocity": 13}

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        suite.free_target(spec)
