"""G1Tracking: a Unitree G1 follows clips with all 29 joints, as in mjlab 1.6.0's Mjlab-Tracking-Flat-Unitree-G1.

The model is MuJoCo Menagerie's, whose masses and armatures are mjlab's. Parts of the robot touch each other and the
ground in the pairs that Menagerie lists. The gains follow from the armatures, as in mjlab.
"""

import math
from pathlib import Path

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp.tasks.tracking import tracking

SIDES, FEET = ("left", "right"), ("left_foot", "right_foot")
LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
WAIST = ("waist_yaw", "waist_roll", "waist_pitch")
ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")
PARTS = [*(f"{side}_{part}" for side in SIDES for part in LEG), *WAIST]
JOINTS = [f"{part}_joint" for part in (*PARTS, *(f"{side}_{part}" for side in SIDES for part in ARM))]
ENDS = [f"{side}_{part}_link" for part in ("ankle_roll", "wrist_yaw") for side in SIDES]
OTHERS = [f"{side}_{part}_link" for part in ("hip_roll", "knee", "shoulder_roll", "elbow") for side in SIDES]
LEG_POSE, ARM_POSE = [-0.312, 0.0, 0.0, 0.669, -0.363, 0.0], [0.2, 0.2, 0.0, 0.6, 0.0, 0.0, 0.0]  # mjlab's, rad
FREQUENCY, DAMPING_RATIO = 2.0 * math.pi * 10.0, 2.0  # of the servos: rad/s


@wp.struct
class Params(tracking.Params):
    joints: wp.array[int] = lw.joints(*JOINTS)
    bodies: wp.array[int] = lw.bodies("torso_link", *ENDS, "pelvis", *OTHERS)
    feet: wp.array[int] = lw.sites(*FEET)
    imu: wp.vec3 = wp.vec3(0.04525, 0.0, -0.08339)
    default_pose: wp.array[float] = [*2 * LEG_POSE, *3 * [0.0], *ARM_POSE, 0.2, -0.2, *ARM_POSE[2:]]
    clips: wp.array2d[float] = str(Path(__file__).with_name("g1.npy"))


class G1(tracking.Tracking):
    """The model of all tracking tasks of the G1."""

    model = lw.menagerie_model("unitree_g1/scene_mjx.xml")

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        """Set mjlab's gains, and leave out the dry friction of the joints."""
        tracking.prepare(spec, FEET, timestep=0.005, iterations=(10, 20))
        for servo in spec.actuators:
            joint = spec.joint(servo.target)
            joint.frictionloss = 0.0
            kp = joint.armature * FREQUENCY**2
            servo.set_to_position(kp=kp, kv=2.0 * DAMPING_RATIO * joint.armature * FREQUENCY)
            servo.inheritrange, servo.ctrllimited = 0.0, False


@lw.register
class G1Tracking(G1):
    pass


@lw.register
class G1BlindTracking(G1):
    """The robot has no estimate of its position and velocity."""

    observe = tracking.blind
