"""Give MuJoCo Warp's model fields one row per world, and recompute the constants derived from them."""

import copy
from collections.abc import Collection, Iterable, Mapping

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from lyceum_warp.core.model_fields import MESH_FIELDS, Constants, ModelField
from lyceum_warp.engines.warp.group import Turns, group_size
from lyceum_warp.engines.warp.warp_kernels import correct_weights, mark_changed, place_geoms, put_meshes
from lyceum_warp.support.arrays import flat

_POSED_BY = {"geom_pos", "geom_quat", "body_pos", "body_quat"}


class StaticGeoms:
    """Computes the poses of static geoms in each world if worlds differ in ``geom_pos`` or a similar field."""

    def __init__(self, model: mujoco.MjModel, varied: Iterable[str], device: wp.Device) -> None:
        body = model.geom_bodyid
        fixed = (model.body_weldid[body] == 0) & (model.body_mocapid[model.body_rootid[body]] == -1)
        fixed &= not _POSED_BY.isdisjoint(varied)
        self._geoms: wp.array = wp.array(np.flatnonzero(fixed), dtype=int, device=device)

    def place(self, model: mjw.Model, data: mjw.Data, mask: wp.array) -> None:
        """Compute the poses in the masked worlds of a Data, by Warp launches only."""
        if self._geoms.size:
            fields = [model.geom_bodyid, model.body_parentid]
            # MuJoCo's quaternions are (w, x, y, z), unlike Warp's type
            geom_quat, body_quat = model.geom_quat.view(wp.vec4), model.body_quat.view(wp.vec4)
            fields += [model.geom_pos, geom_quat, model.body_pos, body_quat]
            args = [mask, self._geoms, *fields, data.geom_xpos, data.geom_xmat]
            wp.launch(place_geoms, (data.nworld, self._geoms.size), args, device=mask.device)


OUTPUTS = {
    Constants.FIXED: "body_subtreemass geom_aabb geom_rbound".split(),
    Constants.KINEMATIC: (
        "tendon_length0 eq_data cam_pos0 cam_poscom0 cam_mat0 light_pos0 light_poscom0 light_dir0".split()
    ),
    Constants.INERTIAL: "dof_invweight0 body_invweight0 tendon_invweight0 actuator_acc0".split(),
}
"""The constants that ``mujoco_warp.set_const`` computes."""

_GEOM_BOUNDS = {"geom_aabb", "geom_rbound"}


def constants_of(fields: Iterable[ModelField]) -> Constants:
    """Return the groups of constants that are derived from any of the fields."""
    groups = Constants.NONE
    for field in fields:
        groups |= field.constants
    return groups & ~Constants.PRIVATE


def outputs_of(fields: Collection[ModelField]) -> list[str]:
    """Return the names of the constants that differ between worlds if the given fields differ."""
    groups = constants_of(fields)
    names = [name for group, outputs in OUTPUTS.items() if group & groups for name in outputs]
    sized = any(field.name == "geom_size" for field in fields)
    return [name for name in names if sized or name not in _GEOM_BOUNDS]


def owner(model: mjw.Model, name: str) -> mjw.Model | mjw.Option:
    """Return the model or its options, whichever has the field as an attribute."""
    return model if hasattr(model, name) else model.opt


def put_varied_model(model: mujoco.MjModel, fields: Collection[ModelField], nworld: int) -> mjw.Model:
    """Make MuJoCo Warp's model with one row per world in the given fields and in the constants derived from them.

    ``mjw.put_model`` disables parts of the physics whose fields are all zero. This function enables the parts whose
    fields may become non-zero in a world.
    """
    fields = [field for field in fields if field.size and field.in_model]
    names = [field.name for field in fields if not field.option]
    names += [name for name in outputs_of(fields) if np.size(getattr(model, name))]
    put = mjw.put_model(model, batch_sizes=dict.fromkeys(names, nworld))
    for field in fields:
        if field.option:
            shared = getattr(put.opt, field.name)
            rows = np.repeat(shared.numpy(), nworld, axis=0)
            setattr(put.opt, field.name, wp.array(rows, dtype=shared.dtype))
    varied = {field.name for field in fields}
    if varied & {"density", "viscosity", "wind"}:
        put.has_fluid = True
    if "tendon_stiffness" in varied:
        put.has_tendon_stiffness = True
    if varied & {"tendon_damping", "actuator_damping"}:
        put.has_tendon_damping = bool(model.ntendon)
    if varied & {"actuator_gainprm", "actuator_biasprm"}:
        affine = np.isin(model.actuator_gaintype, mujoco.mjtGain.mjGAIN_AFFINE.value).any()
        affine |= np.isin(model.actuator_biastype, mujoco.mjtBias.mjBIAS_AFFINE.value).any()
        put.has_efm_actuator = bool(put.has_efm_actuator or affine)
    if varied & {"actuator_damping", "actuator_armature"}:
        every = copy.copy(model)
        for name in varied & {"actuator_damping", "actuator_armature"}:
            getattr(every, name)[:] = 1.0
        mujoco.mj_setConst(every, mujoco.MjData(every))
        put.jnt_actuatorid = wp.array(every.jnt_actuatorid, dtype=int)
        put.tendon_actuatorid = wp.array(every.tendon_actuatorid, dtype=int)
    return put


def set_meshes(model: mjw.Model, arrays: Mapping[str, wp.array], nmesh: int, mask: wp.array) -> None:
    """Set the meshes of the masked worlds from their fields, if meshes differ between worlds, by a Warp launch."""
    if "geom_dataid" in arrays:
        inputs = [arrays[name] for name in MESH_FIELDS]
        outputs = [getattr(model, name) for name in MESH_FIELDS]
        args = [mask, model.geom_type, *inputs, nmesh, *outputs]
        wp.launch(put_meshes, model.geom_dataid.shape, args, device=mask.device)


class ModelRows:
    """Copies a model for a group of worlds. Each given field has one row per world of the group.

    ``take`` fills these rows, because the worlds in the group change. The constructor also copies the fields
    ``written``, because the group writes them.
    """

    def __init__(self, source: mjw.Model, names: Iterable[str], size: int, written: Iterable[str] = ()) -> None:
        self.source = source
        self.model = copy.copy(source)
        self.model.opt = copy.copy(source.opt)
        self._pairs: dict[str, tuple[wp.array, wp.array]] = {}
        for name in names:
            rows = getattr(owner(source, name), name)
            if rows.size:
                group = wp.zeros((size, *rows.shape[1:]), dtype=rows.dtype, device=rows.device)
                setattr(owner(self.model, name), name, group)
                self._pairs[name] = rows, group
        for name in written:
            setattr(self.model, name, wp.clone(getattr(source, name)))

    def take(self, turns: Turns) -> None:
        """Copy the rows of the group's worlds into the group's model."""
        for source, group in self._pairs.values():
            turns.take(source, group)

    def give(self, turns: Turns, names: Iterable[str]) -> None:
        """Copy the given fields of the group back to its worlds."""
        for name in names:
            if name in self._pairs:
                source, group = self._pairs[name]
                turns.give(group, source)


_GROUPS = {
    Constants.FIXED: mjw.SetConstGroup.FIXED,
    Constants.KINEMATIC: mjw.SetConstGroup.KIN0,
    Constants.INERTIAL: mjw.SetConstGroup.INERT0,
}


class ModelConstants:
    """Recomputes constants in the worlds whose fields changed since the last call.

    The constants are computed in a small group of worlds with a separate Data, because ``mujoco_warp.set_const``
    overwrites the kinematics. Tendons may wrap around static geoms, whose poses ``mujoco_warp.set_const`` does not
    compute.
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
            self._values = [flat(getattr(owner(put, name), name)).view(wp.int32) for name in names]
            # no computation produces a NaN with these bits, so all worlds count as changed at first
            self._applied = [wp.full_like(values, -1) for values in self._values]
            self._changed = wp.zeros(nworld, dtype=bool)
            self._everyone = wp.full(size, True, dtype=bool)
            # see correct_weights
            self._weighs: wp.array = wp.array(model.body_invweight0 > 0, dtype=wp.vec2)
            self._sliding: wp.array = wp.array(model.body_simple == 2, dtype=bool)
        self._turns = Turns(nworld, size, device, loop=loop)

    def __call__(self, mask: wp.array) -> None:
        """Update the masked worlds' constants, by Warp launches only."""
        self._changed.zero_()
        for values, applied in zip(self._values, self._applied, strict=True):
            args = [mask, values, applied, self._changed]
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
