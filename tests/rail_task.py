"""Define a task for planner tests: a ball on a rail. The reward is wrong for actions above a limit."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row

_MODEL = """
<mujoco>
  <worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/></body></worldbody>
  <actuator><motor joint="x" gear="{}" {}/></actuator>
</mujoco>
"""


def rail(gear: float = 1.0, limits: str = "") -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(_MODEL.format(gear, limits))


@wp.struct
class Rail:
    qpos: Row[float]
    qvel: Row[float]


@wp.struct
class RailParams:
    dt: float
    limit: float = 0.5
    wrong: float = wp.inf


@wp.func
def observe_rail(s: Rail, p: RailParams, obs: Row[float]):
    obs[0] = s.qpos[0]
    obs[1] = s.qvel[0]


@wp.func
def picky(s0: Rail, action: Row[float], s1: Rail, p: RailParams) -> float:
    if action[0] > p.limit:
        return wp.where(wp.isfinite(p.wrong), p.wrong, p.wrong / p.wrong)  # inf / inf is NaN
    return action[0]


class Picky(lw.Task):
    model = staticmethod(rail)
    obs = {"x": 1, "v": 1}
    World = Rail
    Params = RailParams
    observe, reward = observe_rail, picky
