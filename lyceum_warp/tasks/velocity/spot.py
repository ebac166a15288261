"""SpotVelocity: a Boston Dynamics Spot walks at a commanded velocity. Feet are spheres."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import walking

LEGS, FEET = ("fl", "fr", "hl", "hr"), ("FL", "FR", "HL", "HR")


@wp.struct
class Params(walking.Params):
    joints: wp.array[int] = lw.joints(*(f"{leg}_{joint}" for leg in LEGS for joint in ("hx", "hy", "kn")))
    feet: wp.array[int] = lw.sites(*FEET)
    standing_pose_std: wp.array[float] = 4 * [0.05, 0.05, 0.1]
    walking_pose_std: wp.array[float] = 4 * [0.3, 0.3, 0.6]
    action_scale: wp.array[float] = 12 * [0.25]
    swing_target: float = 0.12
    stages: wp.array2d[float] = [[0.0, -1.0, 1.5, 0.7]]
    lateral_velocity: float = 0.7


@lw.register
class SpotVelocity(walking.Velocity):
    model = lw.playground_model("locomotion/spot/xmls/scene_mjx_feetonly_flat_terrain.xml")
    keyframe, frame_skip = "home", 5
    edit_model = walking.playground_model_edit(FEET)
