"""H1Velocity: a Unitree H1 walks at a commanded velocity with its ten leg joints; torso and arms keep their pose."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import walking

FEET = ("left_foot", "right_foot")
LEG = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle")


@wp.struct
class Params(walking.BipedParams):
    joints: wp.array[int] = lw.joints(*(f"{side}_{joint}" for side in ("left", "right") for joint in LEG))
    feet: wp.array[int] = lw.sites(*FEET)
    walking_pose_std: wp.array[float] = 2 * [0.15, 0.15, 0.3, 0.35, 0.25]
    action_scale: wp.array[float] = 10 * [0.5]
    least_height: float = 0.5


@lw.register
class H1Velocity(walking.Biped):
    model = lw.playground_model("locomotion/h1/xmls/scene_mjx_feetonly.xml")
    edit_model = walking.playground_model_edit(FEET)
