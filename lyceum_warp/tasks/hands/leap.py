"""LeapRotate, LeapReorient and LeapObjects: a LEAP hand turns a cube (MuJoCo Playground's scene) or other objects."""

import mujoco

import lyceum_warp as lw
from lyceum_warp.tasks.hands import reorienting, rotating

FINGERS = ("if", "mf", "rf")
JOINTS = [f"{finger}_{joint}" for finger in FINGERS for joint in ("mcp", "rot", "pip", "dip")]
JOINTS += ["th_cmc", "th_axl", "th_mcp", "th_ipl"]
PARAMS = {"joints": lw.joints(*JOINTS), "tips": lw.sites(*(f"{finger}_tip" for finger in (*FINGERS, "th")))}
MODEL = lw.playground_model("manipulation/leap_hand/xmls/scene_mjx_cube.xml")
SCALES = {
    "airplane": 0.589, "alarmclock": 0.759, "apple": 0.747, "binoculars": 0.71, "bowl": 0.545, "camera": 0.888,
    "cubemedium": 0.813, "cup": 0.726, "cylindermedium": 0.812, "duck": 0.741, "elephant": 0.619, "flashlight": 0.755,
    "gamecontroller": 0.677, "hammer": 0.511, "hand": 0.682, "lightbulb": 0.865, "mouse": 0.897, "mug": 0.632,
    "piggybank": 0.447, "pyramidmedium": 0.813, "spheremedium": 0.838, "stamp": 0.826, "stanfordbunny": 0.537,
    "stapler": 0.855, "teapot": 0.415, "torusmedium": 1.173, "train": 0.752, "watch": 0.977, "waterbottle": 0.769,
}  # fmt: skip
"""Factors for MyoSuite's objects. The box along the principal axes then has the volume of a cube of 6.5 cm, or a
longest side of 10.5 cm if this makes the object smaller."""


def edit(spec: mujoco.MjSpec) -> None:
    """Leave out the sensors, and let nothing touch the goal. Playground limits the iterations of collisions."""
    spec.option.ccd_iterations = 10
    for sensor in list(spec.sensors):
        spec.delete(sensor)
    for geom in spec.body("goal").geoms:
        geom.contype = geom.conaffinity = 0


@lw.register
class LeapRotate(rotating.Rotate):
    model, params, edit_model = MODEL, PARAMS, staticmethod(edit)


@lw.register
class LeapReorient(reorienting.Reorient):
    model, params, edit_model = MODEL, PARAMS, staticmethod(edit)
    objects = lw.Objects(
        "cube",
        {
            name: lw.myosuite_objects(name, scale=scale, mass=0.1, maxhullvert=32)[name]
            for name, scale in SCALES.items()
        },
        condim=3,
    )


def edit_cube(spec: mujoco.MjSpec) -> None:
    """Leave out the cube, so that the worlds hold the objects."""
    edit(spec)
    for geom in list(spec.body("cube").geoms):
        spec.delete(geom)


@lw.register
class LeapObjects(LeapReorient):
    """A LEAP hand turns 29 objects of MyoSuite to goals, a different one in each world."""

    edit_model = staticmethod(edit_cube)
    rewards = {**LeapReorient.rewards, "drop": -30.0, "pose_l2": -0.015, "excess_l2": -0.02}
