"""LeapRotate and LeapReorient: a LEAP hand turns a cube (MuJoCo Playground's scene), or objects of MyoSuite."""

import mujoco

import lyceum_warp as lw
from lyceum_warp.tasks.hands import reorienting, rotating

FINGERS = ("if", "mf", "rf")
JOINTS = [f"{finger}_{joint}" for finger in FINGERS for joint in ("mcp", "rot", "pip", "dip")]
JOINTS += ["th_cmc", "th_axl", "th_mcp", "th_ipl"]
PARAMS = {"joints": lw.joints(*JOINTS), "tips": lw.sites(*(f"{finger}_tip" for finger in (*FINGERS, "th")))}
MODEL = lw.playground_model("manipulation/leap_hand/xmls/scene_mjx_cube.xml")
LONGEST = {
    "airplane": 0.171, "alarmclock": 0.126, "apple": 0.1, "binoculars": 0.142, "bowl": 0.149, "camera": 0.116,
    "coffeemug": 0.116, "cubemedium": 0.08, "cup": 0.1, "cylindermedium": 0.08, "duck": 0.107, "elephant": 0.136,
    "flashlight": 0.139, "gamecontroller": 0.155, "hammer": 0.182, "hand": 0.149, "lightbulb": 0.085, "mouse": 0.117,
    "mug": 0.116, "piggybank": 0.186, "pyramidmedium": 0.107, "spheremedium": 0.08, "stamp": 0.1,
    "stanfordbunny": 0.163, "stapler": 0.123, "teapot": 0.236, "torusmedium": 0.08, "train": 0.114, "watch": 0.083,
    "waterbottle": 0.137,
}  # fmt: skip
"""Longest side of the bounding box of MyoSuite's objects that a hand of this size can turn, m."""
SIDE = 0.085
"""Longest side of all objects, m."""


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
            name: lw.myosuite_objects(name, scale=SIDE / side, density=315, maxhullvert=32)[name]
            for name, side in LONGEST.items()
        },
        condim=3,
    )
