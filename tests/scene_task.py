"""Define a task whose pictures show a flex, a mocap body, and random model fields."""

import mujoco
import warp as wp
from arbitrary_models import ARM, text

import lyceum_warp as lw
from lyceum_warp import Row

SCENE = text(
    ARM + '<camera name="eye" pos="0 -3 1" xyaxes="1 0 0 0 0 1" mode="targetbodycom" target="arm"/>'
    '<body name="lamp" pos="0 -2 2"><joint type="slide" axis="1 0 0"/><geom size=".1"/>'
    '<light mode="targetbodycom" target="arm"/></body>'
    '<body name="target" mocap="true" pos=".3 0 .6"><geom size=".1"/></body>'
    '<flexcomp name="cloth" type="grid" dim="2" count="3 3 1" spacing=".1 .1 .1" pos=".4 0 1" radius=".02" mass=".1">'
    '<contact selfcollide="none"/><edge equality="true"/></flexcomp>'
)


@wp.struct
class World:
    qpos: Row[float]
    mocap_pos: Row[wp.vec3]
    cam_pos: Row[wp.vec3]
    cam_fovy: Row[float]
    geom_pos: Row[wp.vec3]
    geom_rgba: Row[wp.vec4]
    light_diffuse: Row[wp.vec3]


@wp.struct
class Params:
    floor: int = lw.geom("floor")
    end: int = lw.site("end")


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[0] = lw.uniform(rng, -1.0, 1.0)
    s.cam_pos[0] = s.cam_pos[0] + wp.vec3(lw.uniform(rng, -0.2, 0.2), 0.0, 0.0)
    s.cam_fovy[0] = lw.uniform(rng, 30.0, 60.0)
    s.geom_pos[p.floor] = wp.vec3(0.0, 0.0, lw.uniform(rng, -0.5, 0.0))
    s.geom_rgba[p.floor] = wp.vec4(lw.uniform(rng, 0.0, 1.0), 0.5, 0.5, 1.0)
    s.light_diffuse[0] = wp.vec3(lw.uniform(rng, 0.2, 1.0), 0.5, 0.5)


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    if lw.uniform(rng, 0.0, 1.0) < 0.4:
        s.qpos[1] = s.qpos[1] + 0.1
        s.mocap_pos[0] = s.mocap_pos[0] + wp.vec3(0.0, 0.0, 0.1)


class Scene(lw.Task):
    """An arm, a cloth and a mocap body. The camera and the light turn to the arm."""

    model = staticmethod(lambda: mujoco.MjSpec.from_string(SCENE))
    frame_skip = 2
    obs = {"hinge": 1}
    horizon = 4
    cameras = (lw.Camera("eye", 16, 16), lw.Camera("eye", 16, 16, "depth", "depth"))


@wp.struct
class TracedWorld(World):
    site_xpos: Row[wp.vec3]
    travel: Row[float] = lw.memory()


@wp.func
def trace(s: TracedWorld, p: Params):
    s.travel[0] = s.travel[0] + s.site_xpos[p.end][0]


class Traced(Scene):
    """The substeps read a pose."""

    World = TracedWorld
    substep = trace
