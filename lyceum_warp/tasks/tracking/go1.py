"""Go1Tracking: a Unitree Go1 follows clips.

The parts of the robot that collide have no friction, apart from the feet.
"""

from pathlib import Path

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp.tasks.tracking import tracking

LEGS = ("FR", "FL", "RR", "RL")
FEET = [f"{leg}_foot" for leg in LEGS]


@wp.struct
class Params(tracking.Params):
    joints: wp.array[int] = lw.joints(*(f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "thigh", "calf")))
    bodies: wp.array[int] = lw.bodies("trunk", *(f"{leg}_{part}" for part in ("calf", "thigh", "hip") for leg in LEGS))
    feet: wp.array[int] = lw.sites(*FEET)
    foot_geoms: wp.array[int] = lw.geoms(*FEET)
    imu: wp.vec3 = wp.vec3(-0.01592, -0.06659, -0.00617)
    default_pose: wp.array[float] = 2 * [0.1, 0.9, -1.8, -0.1, 0.9, -1.8]
    clips: wp.array2d[float] = str(Path(__file__).with_name("go1.npy"))
    height_limit: float = 0.15


@lw.register
class Go1Tracking(tracking.Tracking):
    model = str(Path(__file__).parents[1] / "velocity/go1.xml")

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        tracking.prepare(spec, FEET, timestep=0.005, iterations=(10, 20))
