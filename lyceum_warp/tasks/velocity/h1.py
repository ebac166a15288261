"""H1Velocity: a Unitree H1 walks at a commanded velocity with its ten leg joints; torso and arms keep their pose."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import walkers
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

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Add force sensors to the feet, and ignore the friction of the ground."""
        walkers.prepare_walker(spec, FEET, timestep=0.004, iterations=(3, 5))
