"""Walker2d: walk forward on two legs (Gymnasium's Walker2d-v5), with the reward of the task hopper."""

import math

import lyceum_warp as lw
from lyceum_warp.tasks.hopper import Hopper


@lw.register
class Walker2d(Hopper):
    model, frame_skip, gymnasium = "walker2d_v5.xml", 4, "Walker2d-v5"
    obs = staticmethod(lambda p: {"position": 9 - p.exclude_current_positions_from_observation, "velocity": 9})
    params = {
        "healthy_state_range": (-math.inf, math.inf),
        "healthy_z_range": (0.8, 2.0),
        "healthy_angle_range": (-1.0, 1.0),
    }
    physics, planning = {}, lw.Planning()
