"""Tasks whose worlds hold different objects, which fall on a floor between two walls and are pushed by a rod."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    object: Row[float]
    body_mass: Row[float]


@wp.struct
class Params:
    dt: float
    body: int = lw.body("object")
    heaviest: float = 1.0


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    for i in range(13):
        obs[i] = wp.where(i < 7, s.qpos[wp.min(i, 6)], s.qvel[wp.max(i, 7) - 7])
    obs[13] = s.object[0]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return s1.qpos[2] - 0.1 * s1.object[0] + 0.01 * action[0]


@wp.func
def success(s: World, p: Params) -> bool:
    return s.object[0] == 1.0


@wp.func
def terminated(s: World, p: Params) -> bool:
    return s.qpos[0] > 1.0


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[0] += lw.uniform(rng, -0.05, 0.05)
    turn = lw.quat_random(rng)
    for i in range(4):
        s.qpos[3 + i] = turn[i]


SCENE = """
<mujoco>
  <option timestep="0.004" cone="elliptic"/>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 .1"/>
    <geom type="box" size=".02 .3 .05" pos=".2 0 .05"/>
    <geom type="box" size=".02 .3 .05" pos="-.2 0 .05"/>
    <body name="object" pos="0 0 .2"><freejoint/></body>
    <body name="rod" pos="0 .3 .04">
      <joint name="swing" axis="0 0 1" damping=".01"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 -.3 0" density="200"/>
    </body>
  </worldbody>
  <actuator><motor joint="swing" gear=".3" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


class Drop(lw.Task):
    model = mujoco.MjSpec.from_string(SCENE)
    frame_skip, horizon = 4, 40
    obs = {"pose": 7, "velocity": 6, "object": 1}
    objects = lw.Objects(
        "object",
        {
            "cube": lw.shape("box", 0.04, 0.05, 0.03, density=400, rgba=(1, 0, 0, 1)),
            "ball": lw.shape("sphere", 0.05, friction=(0.4, 0.01, 0.001)),
            "wedge": lw.mesh("data/wedge.obj", scale=1.2, density=600),
            "dumbbell": [
                lw.shape("sphere", 0.03, pos=(0, 0, 0.06)),
                lw.shape("sphere", 0.04, pos=(0, 0, -0.05)),
                lw.shape("capsule", 0.01, 0.05, solref=(0.01, 1)),
            ],
        },
        condim=4,
    )


@wp.func
def draw_mass(s: World, p: Params, rng: Row[wp.uint32]):
    randomize(s, p, rng)
    s.body_mass[p.body] = s.body_mass[p.body] * lw.uniform(rng, 0.5, 1.5)


class DrawnDrop(Drop):
    """Draws an object and its mass at every reset."""

    randomize = draw_mass
    objects = lw.Objects("object", Drop.objects.models, redraw=True, condim=4)
