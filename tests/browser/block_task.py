"""A task for tests in a browser: a red block on a rail, quick to draw by a browser without a GPU."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

_MODEL = """
<mujoco>
  <option timestep="0.02"/>
  <statistic center="0 0 .4" extent="3"/>
  <visual><quality shadowsize="256" offsamples="1"/></visual>
  <worldbody>
    <light pos="0 0 5" dir="0 0 -1" castshadow="false"/>
    <geom type="plane" size="3 3 .1" rgba=".3 .35 .4 1"/>
    <body name="block" pos="0 0 .4">
      <joint name="x" type="slide" axis="1 0 0" damping="4" limited="true" range="-.6 .6"/>
      <geom type="box" size=".4 .4 .4" rgba=".9 .05 .05 1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="x" gear="4" ctrllimited="true" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


def block() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(_MODEL)


@wp.struct
class BlockWorld:
    qpos: Row[float]
    qvel: Row[float]


@wp.struct
class BlockParams:
    dt: float


@wp.func
def observe_block(s: BlockWorld, p: BlockParams, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.qvel[0]


@wp.func
def speed_of_block(s0: BlockWorld, action: Row[float], s1: BlockWorld, p: BlockParams) -> float:
    return s1.qvel[0]


class Block(lw.Task):
    model = staticmethod(block)
    obs = {"x": 1, "v": 1}
    horizon = 100_000
    World = BlockWorld
    Params = BlockParams
    observe = observe_block
    reward = speed_of_block
