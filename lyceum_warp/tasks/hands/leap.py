"""LeapRotate and LeapReorient: a LEAP hand turns a cube (MuJoCo Playground's scene)."""

import mujoco

import lyceum_warp as lw
from lyceum_warp.tasks.hands import reorienting, rotating

MODEL = lw.playground_model("manipulation/leap_hand/xmls/scene_mjx_cube.xml")


def edit(spec: mujoco.MjSpec) -> None:
    """Leave out the sensors, and let nothing touch the goal."""
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for geom in spec.body("goal").geoms:
        geom.contype = geom.conaffinity = 0


@lw.register
class LeapRotate(rotating.Rotate):
    model, edit_model = MODEL, staticmethod(edit)


@lw.register
class LeapReorient(reorienting.Reorient):
    model, edit_model = MODEL, staticmethod(edit)
