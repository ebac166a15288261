"""Go1Velocity: a Unitree Go1 walks at a commanded velocity, as in mjlab 1.6.0's Mjlab-Velocity-Flat-Unitree-Go1.

Joints and feet are in the order FR, FL, RR, RL. Each leg has hip, thigh and calf. Feet are spheres.
"""

import warp as wp

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import walking

LEGS = ("FR", "FL", "RR", "RL")
FEET = [f"{leg}_foot" for leg in LEGS]


@wp.struct
class Params(walking.Params):
    joints: wp.array[int] = lw.joints(*(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "calf")))
    feet: wp.array[int] = lw.sites(*FEET)
    foot_geoms: wp.array[int] = lw.geoms(*FEET)
    imu: wp.vec3 = wp.vec3(-0.01592, -0.06659, -0.00617)
    default_pose: wp.array[float] = 2 * [0.1, 0.9, -1.8, -0.1, 0.9, -1.8]
    standing_pose_std: wp.array[float] = 4 * [0.05, 0.05, 0.1]
    walking_pose_std: wp.array[float] = 4 * [0.3, 0.3, 0.6]
    start_height: float = 0.278


@lw.register
class Go1Velocity(walking.Velocity):
    model = "go1.xml"
    training = lw.Training(algorithm="ppo", settings={"symmetry": "exact"}, iterations=300, physics="coarse")
