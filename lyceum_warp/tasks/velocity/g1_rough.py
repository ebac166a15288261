"""G1RoughVelocity: a Unitree G1 walks at a commanded velocity on rough ground, and scans it."""

import dataclasses

import mujoco

import lyceum_warp as lw
from lyceum_warp import walkers
from lyceum_warp.tasks.velocity import g1, rough


@lw.register
class G1RoughVelocity(rough.Rough, g1.G1):
    training = dataclasses.replace(g1.G1.training, iterations=1200, physics=None, exact_from=None)

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        walkers.round_feet(spec, g1.FEET)
        rough.TERRAIN.add_to(spec)
