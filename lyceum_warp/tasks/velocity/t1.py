"""T1Velocity: a Booster T1 walks at a commanded velocity with its twelve leg joints; its upper body keeps still."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import walking

FEET = ("left_foot", "right_foot")
LEG = ("Hip_Pitch", "Hip_Roll", "Hip_Yaw", "Knee_Pitch", "Ankle_Pitch", "Ankle_Roll")

SERVOS = {
    "Head": (10.0, 1.0, 0.001),
    "Shoulder": (50.0, 1.0, 0.0282528),
    "Elbow": (50.0, 1.0, 0.0282528),
    "Waist": (200.0, 5.0, 0.0478125),
    "Hip_Pitch": (200.0, 5.0, 0.0523908),
    "Hip_Roll": (200.0, 5.0, 0.0478125),
    "Hip_Yaw": (200.0, 5.0, 0.0478125),
    "Knee": (200.0, 5.0, 0.0636012),
    "Ankle": (50.0, 1.0, 0.0679104),
}
"""Stiffness (N m/rad), damping (N m s/rad) and armature (kg m²) by a word in the joint's name, as in Booster's training
code (T1_CFG of booster_train)."""


@wp.struct
class Params(walking.BipedParams):
    joints: wp.array[int] = lw.joints(*(f"{side}_{joint}" for side in ("Left", "Right") for joint in LEG))
    feet: wp.array[int] = lw.sites(*FEET)
    walking_pose_std: wp.array[float] = 2 * [0.3, 0.15, 0.15, 0.35, 0.25, 0.1]
    action_scale: wp.array[float] = 12 * [0.25]
    least_height: float = 0.3


@lw.register
class T1Velocity(walking.Biped):
    model = lw.playground_model("locomotion/t1/xmls/scene_mjx_feetonly_flat_terrain.xml")
    physics = {"coarse": lw.PhysicsOptions(integrator="discrete", frame_skip=2, timestep=0.01)}
    training = lw.Training(
        algorithm="ppo", settings={"log_std": -0.7, "symmetry": "exact"}, iterations=800, physics="coarse"
    )
    rewards = walking.Biped.rewards | {"track_linear_velocity": 4.0, "action_rate_l2": -0.02, "single_stance": 1.0}

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Set Booster's servos, whose targets may exceed the joint ranges.

        Playground's servos (30 N m/rad, targets within the ranges) extend a knee with at most 12 of its motor's 60 N m
        in the initial pose, and the robot falls.
        """
        walking.playground_model_edit(FEET)(spec)
        for servo in spec.actuators:
            joint = spec.joint(servo.target)
            kp, kv, joint.armature = next(values for word, values in SERVOS.items() if word in joint.name)
            joint.damping = [0.0, 0.0, 0.0]
            servo.set_to_position(kp=kp, kv=kv)
            servo.inheritrange, servo.ctrllimited = 0.0, False
