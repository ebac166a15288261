"""PointMassEasy: move a mass on a table to the target in the middle."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    geom_xpos: Row[wp.vec3]


@wp.struct
class Params(suite.RandomJoints):
    mass: int = lw.geom("pointmass")
    target: int = lw.geom("target")
    target_size: float = lw.from_model(lambda model, p: model.geom_size[p.target, 0])  # radius, m
    margin: float = lw.from_model(lambda model, p: p.target_size)  # m


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    k = lw.put(obs, 0, s.qpos)
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    distance = wp.length(s1.geom_xpos[p.target] - s1.geom_xpos[p.mass])
    return lw.tolerance(distance, wp.vec2(0.0, p.target_size), p.margin) * suite.small_control(action)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    suite.draw_joints(s.qpos, p.drawn_joints, p.drawn_range, rng)


@lw.register
class PointMassEasy(lw.Task):
    model, frame_skip = suite.model("point_mass"), 1
    obs = {"position": 2, "velocity": 2}
    # the planner's margin around the target and its time step are larger than the task's
    planning = lw.Planning(
        settings={"horizon": 50, "temperature": 0.05}, options={"timestep": 0.04}, params={"margin": 0.2}
    )
