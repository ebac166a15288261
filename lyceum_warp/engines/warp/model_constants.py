"""Constants of a model that follow from fields that differ between worlds."""

from collections.abc import Collection

import mujoco
import mujoco_warp as mjw
import warp as wp

from lyceum_warp.arrays import flat
from lyceum_warp.engines.warp.group_turns import Turns, group_size
from lyceum_warp.engines.warp.model_rows import OUTPUTS, ModelRows, constants_of, outputs_of, owner
from lyceum_warp.engines.warp.partial_kernels import correct_weights, mark_changed
from lyceum_warp.engines.warp.static_geoms import StaticGeoms
from lyceum_warp.model_fields import Constants, ModelField

_GROUPS = {
    Constants.FIXED: mjw.SetConstGroup.FIXED,
    Constants.KINEMATIC: mjw.SetConstGroup.KIN0,
    Constants.INERTIAL: mjw.SetConstGroup.INERT0,
}


class ModelConstants:
    """Recomputes constants in the worlds where fields changed since last time.

    The constants are a function of the fields alone. They are computed in a small group of worlds with data of its own,
    because this overwrites kinematics.

    Args:
        model: The compiled model.
        put: MuJoCo Warp's model, with a row for each world in the fields and in the constants that follow.
        fields: The fields that differ between worlds, with constants that follow.
        static: Geoms whose poses ``mujoco_warp.set_const`` does not compute, and around which tendons may be wrapped.
        nworld: Number of worlds.
        device: Where they live.
        loop: As for ``Turns``.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        put: mjw.Model,
        fields: Collection[ModelField],
        static: StaticGeoms,
        nworld: int,
        device: wp.Device,
        *,
        loop: bool = True,
    ) -> None:
        groups = constants_of(fields)
        self._outputs = outputs_of(fields)
        self._static = static
        self._flags = int(sum(int(flag) for group, flag in _GROUPS.items() if group & groups))
        written = {name for group, names in OUTPUTS.items() if group & groups for name in names}
        size = group_size(nworld, device) if loop else nworld
        with wp.ScopedDevice(device):
            names = [field.name for field in fields]
            self._rows = ModelRows(put, [*names, *self._outputs], size, written - set(self._outputs))
            self._scratch = mjw.make_data(model, nworld=size, nconmax=1, njmax=1)
            self._given = [flat(getattr(owner(put, name), name)).view(wp.int32) for name in names]
            # the bits of a NaN, from which every value differs
            self._applied = [wp.full_like(given, -1) for given in self._given]
            self._changed = wp.zeros(nworld, dtype=bool)
            self._everyone = wp.full(size, True, dtype=bool)
            # weights that are 0 in MuJoCo stay 0, and bodies with sliders only have those of their mass
            self._weighs: wp.array = wp.array(model.body_invweight0 > 0, dtype=wp.vec2)
            self._sliding: wp.array = wp.array(model.body_simple == 2, dtype=bool)
        self._turns = Turns(nworld, size, device, loop=loop)

    def __call__(self, mask: wp.array) -> None:
        """Bring the masked worlds' constants up to date; made of launches."""
        self._changed.zero_()
        for given, applied in zip(self._given, self._applied, strict=True):
            args = [mask, given, applied, self._changed]
            wp.launch(mark_changed, len(mask), args, device=mask.device)
        self._turns.run(self._changed, self._turn)

    def _turn(self) -> None:
        self._rows.take(self._turns)
        model = self._rows.model
        self._static.place(model, self._scratch, self._everyone)
        mjw.set_const(model, self._scratch, self._flags, restore=False)
        if "body_invweight0" in self._outputs:
            dim = (self._scratch.nworld, len(self._sliding))
            places = [self._weighs, self._sliding, model.body_dofadr, model.body_dofnum]
            weights = [model.body_mass, model.body_invweight0, model.dof_invweight0]
            wp.launch(correct_weights, dim, [*places, *weights], device=self._sliding.device)
        self._rows.give(self._turns, self._outputs)
