"""AcrobotSwingup: swing up a double pendulum with a motor at the elbow."""

from typing import Any

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.tasks.dm import suite


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    site_xpos: Row[wp.vec3]
    energy: Row[float]  # potential, kinetic


def upright_energy(model: mujoco.MjModel, p: Any) -> float:
    """Return the energy at rest in the upright pose, J."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data.energy.sum()


@wp.struct
class Params:
    margin: float = 1.0  # m
    energy_weight: float = 0.0  # for planners
    energy_margin: float = 40.0  # J, from hanging to upright
    upright_energy: float = lw.from_model(upright_energy)
    tip: int = lw.site("tip")
    target: int = lw.site("target")
    target_size: float = lw.from_model(lambda model, p: model.site_size[p.target, 0])


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    upper, lower = s.qpos[0], s.qpos[0] + s.qpos[1]
    k = lw.put(obs, 0, wp.vec4(wp.sin(upper), wp.sin(lower), wp.cos(upper), wp.cos(lower)))
    lw.put(obs, k, s.qvel)


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    distance = wp.length(s1.site_xpos[p.target] - s1.site_xpos[p.tip])
    near = lw.tolerance(distance, wp.vec2(0.0, p.target_size), p.margin)
    if p.energy_weight == 0.0:
        return near
    missing = p.upright_energy - s1.energy[0] - s1.energy[1]
    return near + p.energy_weight * lw.tolerance(missing, wp.vec2(0.0), p.energy_margin, lw.Sigmoid.LINEAR, 0.0)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    for i in range(2):
        s.qpos[i] = lw.uniform(rng, -wp.pi, wp.pi)


@lw.register
class AcrobotSwingup(lw.Task):
    model, frame_skip = suite.model("acrobot"), 1
    obs = {"orientations": 4, "velocity": 2}
    # the motor is too weak to lift the arms at once, so the planner is rewarded for the energy that it pumps in
    planning = lw.Planning(
        settings={"horizon": 50, "samples": 64, "noise": 2.0, "temperature": 0.2},
        options={"timestep": 0.02, "integrator": "euler"},
        params={"margin": 2.0, "energy_weight": 2.0},
    )


@wp.struct
class SparseParams(Params):
    margin: float = 0.0


@lw.register
class AcrobotSwingupSparse(AcrobotSwingup):
    """Swing up a double pendulum; the reward is 1 near the target and 0 elsewhere."""

    Params = SparseParams
