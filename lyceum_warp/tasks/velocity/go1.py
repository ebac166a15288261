"""Go1Velocity: a Unitree Go1 walks at a commanded velocity, as in mjlab 1.6.0's Mjlab-Velocity-Flat-Unitree-Go1.

Its numbers are mjlab's; docs/velocity.md lists the differences. Joints and feet are in the order FR, FL, RR, RL, with
hip, thigh and calf for each leg. Feet are spheres.
"""

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import velocity


@lw.register
class Go1Velocity(velocity.Velocity):
    model, actions = "go1.xml", {"joint_position": 12}
