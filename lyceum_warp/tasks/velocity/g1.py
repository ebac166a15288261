"""G1Velocity: a Unitree G1 walks at a commanded velocity with its twelve leg joints; waist and arms keep their pose.

The joints' gains stand in the model, MuJoCo Playground's g1_mjx_feetonly.xml: kp from 2 to 75 N m/rad. No other task of
the G1 has a gait clock.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import gait, gates, walking

SIDES, FEET = ("left", "right"), ("left_foot", "right_foot")
LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
WAIST = ("waist_yaw", "waist_roll", "waist_pitch")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
LEGS = [f"{side}_{joint}_joint" for side in SIDES for joint in LEG]
OTHERS = [f"{joint}_joint" for joint in (*WAIST, *(f"{side}_{joint}" for side in SIDES for joint in ARM))]
LEG_STD = [0.3, 0.15, 0.15, 0.35, 0.25, 0.1]  # mjlab's
OTHER_STD = [0.2, 0.08, 0.1, *2 * [0.15, 0.15, 0.1, 0.15, 0.3, 0.3, 0.3]]


@wp.struct
class Params(walking.BipedParams):
    joints: wp.array[int] = lw.joints(*LEGS)
    feet: wp.array[int] = lw.sites(*FEET)
    imu: wp.vec3 = wp.vec3(0.04525, 0.0, -0.08339)
    walking_pose_std: wp.array[float] = 2 * LEG_STD
    action_scale: wp.array[float] = 12 * [0.5]
    swing_target: float = 0.12  # the sites are 0.04 m above the soles
    least_height: float = 0.35
    stages: wp.array2d[float] = [[0.0, -0.6, 1.0, 1.0]]
    lateral_velocity: float = 0.5


@wp.struct
class FullParams(Params):
    joints: wp.array[int] = lw.joints(*LEGS, *OTHERS)
    walking_pose_std: wp.array[float] = [*2 * LEG_STD, *OTHER_STD]
    action_scale: wp.array[float] = [*12 * [0.5], *17 * [0.25]]


@wp.struct
class GaitParams(gait.Params, Params):
    walking_pose_std: wp.array[float] = 2 * [0.4, 0.15, 0.15, 0.6, 0.35, 0.15]


class G1(walking.Biped):
    """The model of all G1 tasks."""

    model = lw.playground_model("locomotion/g1/xmls/scene_mjx_feetonly_flat_terrain.xml")
    gate = gates.NanoG1(legs=len(LEGS))
    physics = {"coarse": lw.PhysicsOptions(integrator="discrete", frame_skip=2, timestep=0.01)}
    edit_model = walking.playground_model_edit(FEET)


@lw.register
class G1Velocity(gait.Gait, G1):
    Params = GaitParams


@lw.register
class G1FullVelocity(G1):
    """A Unitree G1 walks at a commanded velocity with all 29 joints."""

    Params = FullParams
