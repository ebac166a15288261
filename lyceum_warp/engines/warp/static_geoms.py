"""Poses of geoms that cannot move, in worlds whose models differ.

MuJoCo Warp computes them once, when it makes the data, from the model that all worlds share.
"""

from collections.abc import Iterable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from lyceum_warp.engines.warp.geom_kernels import place_geoms

_POSED_BY = {"geom_pos", "geom_quat", "body_pos", "body_quat"}


class StaticGeoms:
    """The geoms that cannot move, where model fields that place them differ between worlds.

    Args:
        model: The compiled model.
        varied: The names of the model fields that differ.
        device: Where the worlds live.
    """

    def __init__(self, model: mujoco.MjModel, varied: Iterable[str], device: wp.Device) -> None:
        body = model.geom_bodyid
        fixed = (model.body_weldid[body] == 0) & (model.body_mocapid[model.body_rootid[body]] == -1)
        fixed &= not _POSED_BY.isdisjoint(varied)
        self._geoms: wp.array = wp.array(np.flatnonzero(fixed), dtype=int, device=device)

    def place(self, model: mjw.Model, data: mjw.Data, mask: wp.array) -> None:
        """Compute their poses in the masked worlds of a data; made of launches."""
        if self._geoms.size:
            fields = [model.geom_bodyid, model.body_parentid]
            # quaternions as numbers in MuJoCo's order, which Warp's type would take for another
            geom_quat, body_quat = model.geom_quat.view(wp.vec4), model.body_quat.view(wp.vec4)
            fields += [model.geom_pos, geom_quat, model.body_pos, body_quat]
            args = [mask, self._geoms, *fields, data.geom_xpos, data.geom_xmat]
            wp.launch(place_geoms, (data.nworld, self._geoms.size), args, device=mask.device)
