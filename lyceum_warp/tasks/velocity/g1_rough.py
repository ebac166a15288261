"""G1RoughVelocity: a Unitree G1 walks at a commanded velocity on rough ground, and scans it."""

import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import walkers
from lyceum_warp.tasks.velocity import g1, rough


@wp.struct
class Params(rough.Params, g1.Params):
    pass


@lw.register
class G1RoughVelocity(rough.Rough, g1.G1):
    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        g1.G1.edit_model(spec)
        walkers.round_feet(spec, g1.FEET)
        rough.TERRAIN.add_to(spec)
