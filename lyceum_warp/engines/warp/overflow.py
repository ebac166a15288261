"""Faults from MuJoCo Warp's overflow bits."""

import mujoco_warp as mjw
import warp as wp

from lyceum_warp.kernels import faults

_BITS = mjw.OverflowType

CONTACT_BITS = int(_BITS.BROADPHASE | _BITS.NARROWPHASE)
CONSTRAINT_BITS = int(_BITS.NEFC | _BITS.NJMAX_NNZ | _BITS.NVMAX)
IGNORED_BITS = int(_BITS.ITERATIONS | _BITS.LS_ITERATIONS)
"""A solver that reached its limit of iterations still has an answer."""


def report_pool_overflow(data: mjw.Data, mask: wp.array) -> None:
    """Set the masked worlds' bit of an overflow where a forward pass found no room for contacts.

    ``mujoco_warp.step`` sets it; ``mujoco_warp.forward`` does not.
    """
    pool = [data.ncollision, data.nacon, data.naconmax, int(_BITS.NARROWPHASE)]
    wp.launch(faults.pool_overflow, data.nworld, [mask, *pool, data.overflow], device=mask.device)
