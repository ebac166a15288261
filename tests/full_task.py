"""Define a task that uses every feature: a puck on the floor, and a movable paddle."""

from typing import Any

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

XML = """
<mujoco model="puck">
  <option timestep="0.005"/>
  <size nuserdata="2"/>
  <worldbody>
    <geom name="floor" type="plane" size="3 3 .1"/>
    <body name="paddle" mocap="true" pos="1 0 .1"><geom name="paddle" type="box" size=".05 .2 .1"/></body>
    <body name="puck" pos="0 0 .1">
      <joint name="x" type="slide" axis="1 0 0" damping=".2"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="puck" type="box" size=".1 .1 .1" mass="1"/>
      <site name="top" pos="0 0 .1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x" gear="5" ctrllimited="true" ctrlrange="-1 1"/></actuator>
  <keyframe><key name="start" qpos=".2 .01" mpos=".9 0 .1"/></keyframe>
</mujoco>
"""


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    site_xpos: Row[wp.vec3]
    xfrc_applied: Row[wp.spatial_vector]
    mocap_pos: Row[wp.vec3]
    userdata: Row[float]
    body_mass: Row[float]
    geom_friction: Row[wp.vec3]
    gravity: Row[float]
    dof_damping: Row[float]
    geom_size: Row[wp.vec3]
    travel: Row[float] = lw.memory()
    smooth: Row[float] = lw.memory()
    draws: Row[float] = lw.lasting_memory()


@wp.struct
class Params:
    dt: float
    substep_dt: float
    noise: float = 0.1
    wind: float = 3.0
    kick: float = 0.5
    cost: float = 0.1
    puck: int = lw.body("puck")
    geom: int = lw.geom("puck")
    top: int = lw.site("top")
    joints: wp.array[int] = lw.qposes("x", "z")


@wp.struct
class Policy:
    position: Row[float] = lw.part("joints")
    top: Row[float] = lw.part()


@wp.struct
class Critic(Policy):
    velocity: Row[float] = lw.part()
    dynamics: Row[wp.vec4] = lw.part()
    memory: Row[float] = lw.part(3)
    paddle: Row[wp.vec3] = lw.part()
    userdata: Row[float] = lw.part()


@wp.func
def observe_body(s: World, p: Params, obs: Any):  # for both groups
    for i in range(p.joints.shape[0]):
        obs.position[i] = s.qpos[p.joints[i]]
    obs.top[0] = s.site_xpos[p.top][0]


@wp.func
def observe(s: World, p: Params, obs: Policy, rng: Row[wp.uint32]):
    observe_body(s, p, obs)
    for i in range(p.joints.shape[0]):
        obs.position[i] += p.noise * lw.normal(rng)


@wp.func
def observe_critic(s: World, p: Params, obs: Critic):
    observe_body(s, p, obs)
    obs.velocity[0] = s.qvel[0]
    obs.dynamics[0] = wp.vec4(s.body_mass[p.puck], s.geom_friction[p.geom][0], s.gravity[2], s.dof_damping[0])
    obs.memory[0] = s.travel[0]
    obs.memory[1] = s.smooth[0]
    obs.memory[2] = s.draws[0]
    obs.paddle[0] = s.mocap_pos[0]
    obs.userdata[0] = s.userdata[0]


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    ctrl[0] = action[0] - 0.1 * s.qvel[0]
    s.xfrc_applied[p.puck] = wp.spatial_vector(p.wind * action[1], 0.0, 0.0, 0.0, 0.0, 0.0)
    s.mocap_pos[0] = wp.vec3(0.9 + 0.3 * action[2], 0.0, 0.1)
    s.userdata[0] = s.userdata[0] + action[2]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return s1.qpos[0] - s0.qpos[0] - p.cost * action[0] * action[0] + 0.01 * s1.smooth[0]


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    metrics[0] = (s1.qpos[0] - s0.qpos[0]) / p.dt
    metrics[1] = p.cost * action[0] * action[0]


@wp.func
def evaluate(s: World, p: Params) -> float:
    return s.qpos[0]


@wp.func
def terminated(s: World, p: Params) -> bool:
    return s.qpos[0] > 0.6


@wp.func
def success(s: World, p: Params) -> bool:
    return s.qpos[0] > 0.25


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    s.gravity[2] = s.gravity[2] * lw.uniform(rng, 0.9, 1.1)


@wp.func
def initialize(s: World, p: Params):
    s.smooth[0] = 0.5


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[0] = s.qpos[0] + lw.uniform(rng, -0.2, 0.2)
    s.body_mass[p.puck] = s.body_mass[p.puck] * lw.uniform(rng, 0.5, 2.0)
    s.geom_friction[p.geom][0] = s.geom_friction[p.geom][0] * lw.uniform(rng, 0.2, 1.5)
    s.draws[0] = s.draws[0] + 1.0


@wp.func
def reject(s: World, p: Params) -> bool:
    return s.site_xpos[p.top][0] < 0.2


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    if lw.uniform(rng, 0.0, 1.0) < 0.4:
        s.qpos[0] = s.qpos[0] + p.kick * lw.uniform(rng, -0.1, 0.1)
        s.qvel[0] = s.qvel[0] + p.kick * lw.uniform(rng, -1.0, 1.0)
        s.dof_damping[0] = s.dof_damping[0] * lw.uniform(rng, 0.5, 2.0)


@wp.func
def substep(s: World, p: Params):
    s.travel[0] = s.travel[0] + p.substep_dt * s.qvel[0]


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.smooth[0] = 0.9 * s0.smooth[0] + 0.1 * lw.normal(rng)


class Full(lw.Task):
    """Episodes begin at a keyframe. Invalid initial states are replaced by new random states."""

    model = staticmethod(lambda: mujoco.MjSpec.from_string(XML))
    frame_skip = 3
    metrics = ("speed", "cost")
    actions = {"push": 1, "wind": 1, "paddle": 1}
    action_range = (-1.0, 1.0)
    keyframe = "start"
    horizon = 20
    success_steps = 3


class Settled(Full):
    """The puck falls to the floor before the episode begins."""

    settle = 4
