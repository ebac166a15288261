"""T1Velocity: a Booster T1 walks at a commanded velocity with its twelve leg joints; its upper body keeps still."""

import warp as wp

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import walking

FEET = ("left_foot", "right_foot")
LEG = ("Hip_Pitch", "Hip_Roll", "Hip_Yaw", "Knee_Pitch", "Ankle_Pitch", "Ankle_Roll")


@wp.struct
class Params(walking.BipedParams):
    joints: wp.array[int] = lw.joints(*(f"{side}_{joint}" for side in ("Left", "Right") for joint in LEG))
    feet: wp.array[int] = lw.sites(*FEET)
    walking_pose_std: wp.array[float] = 2 * [0.3, 0.15, 0.15, 0.35, 0.25, 0.1]
    action_scale: wp.array[float] = 12 * [0.5]
    least_height: float = 0.3


@lw.register
class T1Velocity(walking.Biped):
    model = lw.playground_model("locomotion/t1/xmls/scene_mjx_feetonly_flat_terrain.xml")
    edit_model = walking.playground_model_edit(FEET)
    physics = {"coarse": lw.PhysicsOptions(integrator="discrete", frame_skip=2, timestep=0.01)}
    training = lw.Training(
        algorithm="ppo", settings={"log_std": -0.7, "symmetry": "exact"}, iterations=800, physics="coarse"
    )
    rewards = walking.Biped.rewards | {"track_linear_velocity": 4.0, "action_rate_l2": -0.02, "single_stance": 1.0}
