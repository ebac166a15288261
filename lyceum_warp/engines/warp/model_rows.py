"""Model fields of MuJoCo Warp with a row for each world, and the rows of a small group of worlds."""

import copy
from collections.abc import Collection, Iterable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from lyceum_warp.engines.warp.group_turns import Turns
from lyceum_warp.model_fields import Constants, ModelField

OUTPUTS = {
    Constants.FIXED: "body_subtreemass geom_aabb geom_rbound".split(),
    Constants.KINEMATIC: (
        "tendon_length0 eq_data cam_pos0 cam_poscom0 cam_mat0 light_pos0 light_poscom0 light_dir0".split()
    ),
    Constants.INERTIAL: "dof_invweight0 body_invweight0 tendon_invweight0 actuator_acc0".split(),
}
"""The constants that ``mujoco_warp.set_const`` writes, by group."""

_GEOM_BOUNDS = {"geom_aabb", "geom_rbound"}


def constants_of(fields: Iterable[ModelField]) -> Constants:
    """The groups of constants that follow from any of some fields."""
    groups = Constants.NONE
    for field in fields:
        groups |= field.constants
    return groups & ~Constants.PRIVATE


def outputs_of(fields: Collection[ModelField]) -> list[str]:
    """The names of the constants that differ between worlds with some fields."""
    groups = constants_of(fields)
    names = [name for group, outputs in OUTPUTS.items() if group & groups for name in outputs]
    sized = any(field.name == "geom_size" for field in fields)
    return [name for name in names if sized or name not in _GEOM_BOUNDS]


def owner(model: mjw.Model, name: str) -> mjw.Model | mjw.Option:
    """The object whose attribute a model field is: the model or its options."""
    return model if hasattr(model, name) else model.opt


def put_varied_model(model: mujoco.MjModel, fields: Collection[ModelField], nworld: int) -> mjw.Model:
    """MuJoCo Warp's model with a row for each world in some fields and in the constants that follow from them.

    MuJoCo Warp looks at some fields of the model as it is put on the device, and leaves a part of the physics out
    where all of them are zero; that part is kept in for fields that may become non-zero in a world.
    """
    fields = [field for field in fields if field.size]
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


class ModelRows:
    """A model for a group of worlds: the rows of these worlds in fields that differ, and all else shared.

    MuJoCo Warp takes row ``world % rows`` of a field, which in a group is another world's.

    Args:
        whole: The model of all worlds.
        names: The fields with a row for each world.
        size: Places in the group.
        own: Fields that the group needs an array of its own for, because it writes them.
    """

    def __init__(self, whole: mjw.Model, names: Iterable[str], size: int, own: Iterable[str] = ()) -> None:
        self.whole = whole
        self.model = whole
        names = list(names)
        if not names and not own:
            return
        self.model = copy.copy(whole)
        self.model.opt = copy.copy(whole.opt)
        self._pairs: dict[str, tuple[wp.array, wp.array]] = {}
        for name in names:
            source = getattr(owner(whole, name), name)
            if source.size:
                group = wp.zeros((size, *source.shape[1:]), dtype=source.dtype, device=source.device)
                setattr(owner(self.model, name), name, group)
                self._pairs[name] = source, group
        for name in own:
            setattr(self.model, name, wp.clone(getattr(whole, name)))

    def take(self, turns: Turns) -> None:
        """Copy the rows of the group's worlds into the group."""
        if self.model is not self.whole:
            for source, group in self._pairs.values():
                turns.take(source, group)

    def give(self, turns: Turns, names: Iterable[str]) -> None:
        """Copy the group's rows of some fields back into those of its worlds."""
        for name in names:
            if name in self._pairs:
                source, group = self._pairs[name]
                turns.give(group, source)
