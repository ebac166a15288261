"""Define tasks on small models for which both engines agree up to rounding."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

ARM = """
<mujoco model="pushed arm">
  <option timestep="0.005"/>
  <worldbody>
    <body name="hand" mocap="true" pos=".5 0 .3"><site name="grip"/></body>
    <body name="upper" pos="0 0 .3">
      <joint name="shoulder" axis="0 1 0" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03"/>
      <body name="lower" pos=".3 0 0">
        <joint name="elbow" axis="0 1 0" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 .2 0 0" size=".03"/>
        <site name="tip" pos=".2 0 0"/>
      </body>
    </body>
  </worldbody>
  <tendon><spatial stiffness="50" damping="1"><site site="grip"/><site site="tip"/></spatial></tendon>
  <actuator><motor name="elbow" joint="elbow" gear=".5"/></actuator>
</mujoco>
"""


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    xfrc_applied: Row[wp.spatial_vector]
    qfrc_applied: Row[float]
    mocap_pos: Row[wp.vec3]


@wp.struct
class Params:
    dt: float
    force: float = 4.0
    reach: float = 0.1
    lower: int = lw.body("lower")
    hand: int = lw.mocap("hand")
    elbow: int = lw.dof("elbow")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    for i in range(2):
        obs[i] = s.qpos[i]
        obs[2 + i] = s.qvel[i]


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    ctrl[0] = action[0]
    s.xfrc_applied[p.lower] = wp.spatial_vector(0.0, 0.0, p.force * action[1], 0.0, 0.0, 0.0)
    s.qfrc_applied[p.elbow] = 0.1 * action[1]
    s.mocap_pos[p.hand] = wp.vec3(0.5 - p.reach * action[2], 0.0, 0.3 + p.reach * action[2])


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return s1.qpos[0] - s0.qpos[0] - 0.01 * s1.qfrc_applied[p.elbow]


class Pushed(lw.Task):
    """``control`` writes forces on a body and a joint, and the pose of a mocap body."""

    model = staticmethod(lambda: mujoco.MjSpec.from_string(ARM))
    frame_skip = 3
    obs = {"position": 2, "velocity": 2}
    actions = {"elbow": 1, "push": 1, "hand": 1}
    action_range = (-1.0, 1.0)
    horizon = 0


PUCK = """
<mujoco model="puck">
  <option timestep="0.005" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="9 9 .1" friction=".01"/>
    <body name="puck" pos="0 0 .1">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1" damping="50"/>
      <geom name="puck" size=".1" mass="1" friction=".2"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x" gear="8" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@wp.struct
class PuckWorld:
    qpos: Row[float]
    qvel: Row[float]
    body_mass: Row[float]
    geom_friction: Row[wp.vec3]
    gravity: Row[float]


@wp.struct
class PuckParams:
    dt: float
    puck: int = lw.body("puck")
    geom: int = lw.geom("puck")
    spread: float = 0.5


@wp.func
def observe_puck(s: PuckWorld, p: PuckParams, obs: Row[float]):
    for i in range(2):
        obs[i] = s.qpos[i]
        obs[2 + i] = s.qvel[i]
    obs[4] = s.body_mass[p.puck]
    obs[5] = s.geom_friction[p.geom][0]


@wp.func
def weigh_up(s0: PuckWorld, action: Row[float], s1: PuckWorld, p: PuckParams) -> float:
    return s1.body_mass[p.puck] * (s1.qvel[0] - s0.qvel[0])


@wp.func
def draw_gravity(s: PuckWorld, p: PuckParams, rng: Row[wp.uint32]):
    s.gravity[2] = s.gravity[2] * lw.uniform(rng, 0.9, 1.1)


@wp.func
def draw_puck(s: PuckWorld, p: PuckParams, rng: Row[wp.uint32]):
    s.body_mass[p.puck] = s.body_mass[p.puck] * lw.uniform(rng, 1.0 - p.spread, 1.0 + p.spread)
    s.geom_friction[p.geom][0] = s.geom_friction[p.geom][0] * lw.uniform(rng, 1.0 - p.spread, 1.0 + p.spread)


class Drawn(lw.Task):
    """A puck with random mass and friction in each episode, and random gravity in each world."""

    model = staticmethod(lambda: mujoco.MjSpec.from_string(PUCK))
    frame_skip = 3
    obs = {"position": 2, "velocity": 2, "dynamics": 2}
    horizon = 25
    World = PuckWorld
    Params = PuckParams
    observe, reward, startup, randomize = observe_puck, weigh_up, draw_gravity, draw_puck


@wp.func
def observe_gravity(s: PuckWorld, p: PuckParams, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.gravity[2]


class Weighed(Drawn):
    obs = {"x": 1, "gravity": 1}
    World = PuckWorld
    Params = PuckParams
    observe, reward, startup, randomize = observe_gravity, weigh_up, draw_gravity, draw_puck


@wp.struct
class PracticedWorld:
    qpos: Row[float]
    practice: Row[float] = lw.lasting_memory()


@wp.func
def observe_practice(s: PracticedWorld, p: PuckParams, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.practice[0]


@wp.func
def start_further(s: PracticedWorld, p: PuckParams):
    s.qpos[0] = 0.001 * s.practice[0]


@wp.func
def count_steps(s0: PracticedWorld, action: Row[float], s1: PracticedWorld, p: PuckParams, rng: Row[wp.uint32]):
    s1.practice[0] = s0.practice[0] + lw.uniform(rng, 0.0, 2.0)


@wp.func
def draw_practice(s: PracticedWorld, p: PuckParams, rng: Row[wp.uint32]):
    s.practice[0] = lw.uniform(rng, 1.0, 2.0)


class Gifted(lw.Task):
    """A larger ``practice``, which is stored in lasting memory, moves the puck's start further away."""

    model = Drawn.model
    frame_skip = 3
    obs = {"position": 1, "practice": 1}
    horizon = 25
    World = PracticedWorld
    Params = PuckParams
    observe, initialize, advance, startup = observe_practice, start_further, count_steps, draw_practice
