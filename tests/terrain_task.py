"""Define a task on rough ground: a ball with velocity servos, a height scan, and terrain levels."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

KINDS = ("flat", "slope_up", "slope_down", "stairs_up", "stairs_down", "steps", "rough", "waves", "stones")
TERRAIN = lw.Terrain(dict.fromkeys(KINDS, 1), levels=3, patch=4.0, border=2.0)

_MODEL = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <light pos="0 0 20"/>
    <geom name="floor" type="plane" size="1 1 1" condim="1"/>
    <body name="ball">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="z" type="slide" axis="0 0 1" damping="5"/>
      <geom name="ball" size="0.05" mass="1" condim="1" solref="0.01 1"/>
      <site name="ball" zaxis="0 0 -1"/>
    </body>
  </worldbody>
  <actuator>
    <velocity name="x" joint="x" kv="100"/>
    <velocity name="y" joint="y" kv="100"/>
  </actuator>
  <sensor><rangefinder name="down" site="ball"/></sensor>
</mujoco>
"""


@wp.struct
class World:
    qpos: Row[float]
    sensordata: Row[float]
    level: Row[float] = lw.lasting_memory()
    column: Row[float] = lw.lasting_memory()
    walked: Row[float] = lw.lasting_memory()  # distance walked in this episode, m
    commanded: Row[float] = lw.lasting_memory()


@wp.struct
class Params:
    ground: wp.array2d[float] = lw.height_field("terrain")
    origins: wp.array2d[wp.vec3] = TERRAIN.origins
    scan: wp.array[wp.vec2] = lw.scan_grid(0.1, 0.1, spacing=0.005)
    patch: float = TERRAIN.patch
    command: float = 1.0  # m/s
    seconds: float = 5.0  # in an episode
    spread: float = 0.5  # offset of initial positions from the centre of a patch, m


@wp.struct
class Policy:
    position: Row[wp.vec3] = lw.part()
    range: Row[float] = lw.part()
    heights: Row[float] = lw.part("scan")


@wp.func
def observe(s: World, p: Params, obs: Policy):
    base = wp.vec3(s.qpos[0], s.qpos[1], s.qpos[2])
    obs.position[0] = base
    obs.range[0] = s.sensordata[0]
    lw.height_scan(obs.heights, p.ground, p.scan, base, lw.quat(1.0, 0.0, 0.0, 0.0))


@wp.func
def evaluate(s: World, p: Params) -> float:  # the level
    return s.level[0]


@wp.func
def terminated(s: World, p: Params) -> bool:
    return not lw.on_ground(p.ground, s.qpos[0], s.qpos[1])


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    position, distance = wp.vec3(s1.qpos[0], s1.qpos[1], s1.qpos[2]), p.command * p.seconds
    lw.follow_walk(s1.level, s1.column, s1.walked, s1.commanded, p.origins, position, distance)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    reach = wp.vec3(p.spread, p.spread, 0.0)
    start = lw.start_on_terrain(s.level, s.column, s.walked, s.commanded, p.origins, p.patch, rng)
    x = start + lw.uniform(rng, -reach, reach)
    s.qpos[0] = x[0]
    s.qpos[1] = x[1]
    s.qpos[2] = lw.ground_height(p.ground, x[0], x[1]) + 0.2


def ball() -> mujoco.MjSpec:
    spec = mujoco.MjSpec.from_string(_MODEL)
    TERRAIN.add_to(spec)
    return spec


class OnTerrain(lw.Task):
    model, frame_skip, horizon = staticmethod(ball), 5, 250
