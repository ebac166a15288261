"""Define tasks with 48 meshes of MyoSuite (extra "menagerie"): a paddle stirs an object in a tray."""

import mujoco
import warp as wp

import lyceum_warp as lw

NAMES = [name for name in lw.myosuite_objects() if name not in ("eyeglasses", "teapot")]

TRAY = """
<mujoco>
  <option timestep="0.004" cone="elliptic"/>
  <default><geom condim="4"/></default>
  <worldbody>
    <geom type="plane" size="2 2 .1"/>
    <geom type="box" size=".02 .32 .1" pos=".3 0 .1"/>
    <geom type="box" size=".02 .32 .1" pos="-.3 0 .1"/>
    <geom type="box" size=".32 .02 .1" pos="0 .3 .1"/>
    <geom type="box" size=".32 .02 .1" pos="0 -.3 .1"/>
    <body name="object" pos=".12 0 .2"><freejoint/></body>
    <body name="paddle" pos="0 0 .08">
      <joint name="stir" axis="0 0 1" damping=".02"/>
      <geom type="capsule" size=".02" fromto="-.2 0 0 .2 0 0" density="500"/>
    </body>
  </worldbody>
  <actuator><velocity joint="stir" kv=".3" ctrlrange="-6 6"/></actuator>
</mujoco>
"""


@wp.struct
class World:
    qpos: lw.Row[float]
    qvel: lw.Row[float]
    object: lw.Row[float]


@wp.struct
class Params:
    dt: float


@wp.func
def observe(s: World, p: Params, obs: lw.Row[float]):
    for i in range(8):
        obs[i] = s.qpos[i]
        obs[i + 8] = wp.clamp(s.qvel[wp.min(i, 6)], -10.0, 10.0)


@wp.func
def reward(s0: World, action: lw.Row[float], s1: World, p: Params) -> float:
    return wp.length(wp.vec3(s1.qvel[0], s1.qvel[1], s1.qvel[2]))


@wp.func
def terminated(s: World, p: Params) -> bool:
    return wp.max(wp.abs(s.qpos[0]), wp.abs(s.qpos[1])) > 0.4 or s.qpos[2] < -0.05


@wp.func
def randomize(s: World, p: Params, rng: lw.Row[wp.uint32]):
    turn = lw.quat_random(rng)
    for i in range(4):
        s.qpos[3 + i] = turn[i]


class Stir(lw.Task):
    model = mujoco.MjSpec.from_string(TRAY)
    frame_skip, horizon = 5, 250
    obs = {"position": 8, "velocity": 8}
    objects = lw.Objects("object", lw.myosuite_objects(*NAMES, scale=0.7, maxhullvert=32))


class StirRedrawn(Stir):
    objects = lw.Objects("object", Stir.objects.models, redraw=True)
