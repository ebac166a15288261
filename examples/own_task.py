"""Define a task and its model in one file: a pendulum that must swing up with a weak motor.

``python examples/own_task.py`` checks and steps the task. See docs/own_task.md for the command line and model files.
"""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row
from lyceum_warp.testing import check_task

XML = """<mujoco model="pendulum">
  <worldbody>
    <body name="pole" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" damping="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>"""


@wp.struct
class World:  # the fields that the functions read, by MuJoCo's names
    qpos: Row[float]  # angle in rad (0 hangs down), and velocity in rad/s
    qvel: Row[float]


@wp.struct
class Params:  # keyword arguments of lw.make; the package sets dt, the seconds per step
    dt: float
    effort_weight: float = 0.01


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = wp.cos(s.qpos[0])
    obs[1] = wp.sin(s.qpos[0])
    obs[2] = s.qvel[0]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return -wp.cos(s1.qpos[0]) - p.effort_weight * action[0] * action[0]


@lw.register
class Pendulum(lw.Task):
    model = staticmethod(lambda: mujoco.MjSpec.from_string(XML))  # the model may also be a file name
    frame_skip, horizon, obs = 20, 250, {"direction": 2, "velocity": 1}  # a step has 20 substeps of 2 ms


if __name__ == "__main__":
    print(check_task(Pendulum, steps=100))
    env = lw.make(Pendulum, nworld=4, effort_weight=0.1)
    env.action[:] = 0.5  # Nm
    env.step()
    print(f"reward after {env.time[0]:.2f} s: {env.reward[0]:.3f}")
