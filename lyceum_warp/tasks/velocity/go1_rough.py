"""Go1RoughVelocity: a Unitree Go1 walks at a commanded velocity on rough ground, and scans it."""

import mujoco

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import go1, rough


@lw.register
class Go1RoughVelocity(rough.Rough, go1.Go1Velocity):
    training = lw.Training(algorithm="ppo", settings={"symmetry": "exact"}, iterations=1200)

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        rough.TERRAIN.add_to(spec)
