"""Define a task with random masses and lengths: a ball with an arm on a rail."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

_MODEL = """
<mujoco>
  <worldbody>
    <light pos="0 0 3"/>
    <camera name="fixed" pos="0 -4 0" xyaxes="1 0 0 0 0 1"/>
    <body name="ball">
      <joint name="x" type="slide" axis="1 0 0"/>
      <geom name="ball" size=".3" mass="1" rgba="1 0 0 1"/>
      <body name="arm" pos="0 0 .5"><geom name="arm" size=".1" mass="1"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="x" gear="1"/></actuator>
</mujoco>
"""


def ball() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(_MODEL)


@wp.struct
class World:
    qpos: Row[float]
    body_mass: Row[float]
    body_pos: Row[wp.vec3]
    geom_size: Row[wp.vec3]


@wp.struct
class Params:
    dt: float
    ball: int = lw.body("ball")
    arm: int = lw.body("arm")
    ball_geom: int = lw.geom("ball")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    metrics[0] = s1.body_mass[p.ball]
    metrics[1] = s1.body_pos[p.arm][2]


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    s.body_pos[p.arm] = wp.vec3(0.0, 0.0, lw.uniform(rng, 0.4, 0.8))


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.body_mass[p.ball] = s.body_mass[p.ball] * lw.uniform(rng, 0.5, 1.5)
    s.geom_size[p.ball_geom][0] = lw.uniform(rng, 0.1, 0.6)


class Varied(lw.Task):
    model = staticmethod(ball)
    obs = {"x": 1}
    metrics = ("mass", "height")
    horizon = 5
