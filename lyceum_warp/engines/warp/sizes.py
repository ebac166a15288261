"""Probe how many contacts and constraints MuJoCo Warp needs, and estimate its memory."""

import contextlib
import copy
import dataclasses
import hashlib
import logging
from collections.abc import Collection, Mapping
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco.batch import Batch, SimulationError

from lyceum_warp.core.model_fields import ModelField
from lyceum_warp.kernels import faults

log = logging.getLogger(__name__)

_WORLDS, _WORLDS_OF_OBJECT = 48, 16
_HOLDS, _SUBSTEPS = 25, 20

_LEAST, _LEAST_WITH_FLEX = (8, 8), (256, 512)
"""The smallest (nconmax, njmax) without and with a flex. A geom that is pressed into a flex touches up to 50 of its
elements, so a probe may miss many contacts. The second pair is MuJoCo Warp's default."""

_FRICTION = {"dof_frictionloss", "tendon_frictionloss"}
_LIMITS = {"jnt_range", "jnt_margin", "tendon_range", "tendon_margin", "qpos0"}
_CONTACTS = set("geom_margin geom_gap geom_size geom_pos geom_quat pair_margin pair_gap body_pos body_quat".split())
"""Model fields that affect the number of constraints or contacts."""

_cache: dict[str, tuple[int, int]] = {}


def probe_sizes(model: mujoco.MjModel, varied: Collection[ModelField] = ()) -> tuple[int, int]:
    """Measure how many contacts and constraints to allocate for each world.

    Each number is twice the largest count in random rollouts. The number of constraints also includes constraints that
    a task may enable:

    - equality constraints that are inactive in the model
    - all friction losses, if the task randomizes friction losses
    - all limits of joints and tendons, if the task randomizes fields that affect limits

    In the rollouts, 48 worlds run 500 substeps on the C engine. Two thirds of the worlds draw new controls every 20
    substeps. The others hold each control at one of its bounds, because random controls average out: an arm that is
    driven by velocities would hardly leave its initial pose. The worlds start in the model's initial state or a
    keyframe, half of them with random velocities. If the worlds hold different objects, at least 16 worlds hold each
    object. Results are cached for each model.

    Args:
        model: The compiled model.
        varied: The model fields that differ between worlds.

    Returns:
        (nconmax, njmax), both multiples of 8. They are at least (256, 512) if the model has a flex, and at least (8, 8)
        otherwise.

    Raises:
        NotImplementedError, ValueError: MuJoCo Warp does not support the model.
    """
    names = {field.name for field in varied}
    objects = {field.name: field.rows for field in varied if field.rows is not None and field.in_model}
    contacts, constraints = _probe_once(_with_friction_losses(model, names), objects)
    constraints += _inactive(model)
    if not _LIMITS.isdisjoint(names):
        constraints += int(model.jnt_limited.sum() + model.tendon_limited.sum())
    return contacts, -(-constraints // 8) * 8


def warn_of_unknown_sizes(varied: Collection[str], nconmax: int, njmax: int) -> None:
    """Log a warning if randomized fields affect the number of contacts, because the probe uses nominal values."""
    if names := sorted(_CONTACTS.intersection(varied)):
        log.warning(
            "nconmax=%d and njmax=%d were measured on the model's own %s, which the task randomizes: "
            "give make() larger values if worlds end with contact_overflow or constraint_overflow",
            nconmax, njmax, ", ".join(names),
        )  # fmt: skip


def _with_friction_losses(model: mujoco.MjModel, varied: Collection[str]) -> mujoco.MjModel:
    """Copy a model, with friction loss in every joint and tendon if the task randomizes friction loss."""
    if names := _FRICTION.intersection(varied):
        model = copy.copy(model)
        for name in names:
            losses = getattr(model, name)
            losses[losses == 0] = 1e-6
    return model


def _inactive(model: mujoco.MjModel) -> int:
    every = copy.copy(model)
    every.eq_active0[:] = True
    return _equalities(every) - _equalities(model)


def _equalities(model: mujoco.MjModel) -> int:
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    return int(data.ne)


def _probe_once(model: mujoco.MjModel, objects: Mapping[str, np.ndarray]) -> tuple[int, int]:
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    key = hashlib.sha256(b"".join([buffer.tobytes(), *(rows.tobytes() for rows in objects.values())])).hexdigest()
    if key not in _cache:
        _cache[key] = _probe(model, objects)
    return _cache[key]


def _worlds_with(model: mujoco.MjModel, objects: Mapping[str, np.ndarray], rng: np.random.Generator) -> Batch:
    """Make worlds that hold the objects in a random order. The rows of fields are (objects, size)."""
    if not objects:
        return Batch(model, _WORLDS)
    used = np.unique(np.hstack([*objects.values()]), axis=0, return_index=True)[1]
    held = rng.permutation(np.resize(used, max(_WORLDS, _WORLDS_OF_OBJECT * len(used))))
    batch = Batch(model, len(held))
    for name, rows in objects.items():
        expanded = batch.expand(name)
        expanded[:] = rows[held].reshape(expanded.shape)
    batch.set_const()
    return batch


def _probe(model: mujoco.MjModel, objects: Mapping[str, np.ndarray]) -> tuple[int, int]:
    with wp.ScopedDevice("cpu"):
        mjw.put_model(model)  # refuse an unsupported model before the probe, which may take a minute
    rng = np.random.default_rng(0)
    batch = _worlds_with(model, objects, rng)
    nworld = batch.nsim
    ncon, nefc = batch.bind("ncon"), batch.bind("nefc")
    if model.nkey:
        batch.reset(keyframe=np.arange(nworld, dtype=np.int32) % (model.nkey + 1) - 1)
    batch.qvel[: nworld // 2] += rng.normal(size=(nworld // 2, model.nv))
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, (-1.0, 1.0)).T
    contacts = constraints = 0
    # a third of the worlds with random velocities, and a third of those without
    at_bounds = (np.arange(nworld) % (nworld // 2) >= nworld // 3)[:, None]
    bounds = np.where(rng.random((nworld, model.nu)) < 0.5, low, high)
    for _ in range(_HOLDS):
        batch.ctrl[:] = np.where(at_bounds, bounds, rng.uniform(low, high, size=(nworld, model.nu)))
        for _ in range(_SUBSTEPS):
            # the counts are correct even if the memory is too small
            with contextlib.suppress(SimulationError):
                batch.step()
            contacts, constraints = max(contacts, int(ncon.max())), max(constraints, int(nefc.max()))
    least = _LEAST_WITH_FLEX if model.nflex else _LEAST
    sizes = tuple(max(low, -(-2 * peak // 8) * 8) for low, peak in zip(least, (contacts, constraints), strict=True))
    log.info("probed peaks of %d contacts and %d constraints: nconmax=%d, njmax=%d", contacts, constraints, *sizes)
    return sizes[0], sizes[1]


_TEMPORARIES = 1.25
"""The estimated memory of a world, divided by its memory in MuJoCo Warp's Data. In measurements, a step's temporary
arrays took 1 to 9 % of the Data's memory. The rest is room for graphs and for the group of a partial forward pass. CPU
graphs can exceed the estimate, because they keep all temporary arrays alive."""

_TEMPORARIES_CONVEX = 3.5
"""The same factor for models with convex collisions or the noslip solver. On adroit_pen, the temporary arrays take 1.5
to 2.4 times the memory of the Data."""

_CONVEX = {mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_MESH,
           mujoco.mjtGeom.mjGEOM_HFIELD}  # fmt: skip


def data_bytes(model: mujoco.MjModel, nconmax: int, njmax: int) -> int:
    """Estimate the bytes per world of MuJoCo Warp's Data, including temporary arrays."""
    sizes = []
    for nworld in (1, 2):
        with wp.ScopedDevice("cpu"):
            data = mjw.make_data(model, nworld=nworld, naconmax=nworld * nconmax, njmax=njmax)
        sizes.append(_bytes_of(data))
    return int(_margin(model) * (sizes[1] - sizes[0]))


def _bytes_of(data: Any) -> int:
    total = 0
    for field in dataclasses.fields(data):
        value = getattr(data, field.name)
        if isinstance(value, wp.array):
            total += value.size * wp.types.type_size_in_bytes(value.dtype)
        elif dataclasses.is_dataclass(value):
            total += _bytes_of(value)
    return total


def _margin(model: mujoco.MjModel) -> float:
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    kinds = [int(kind) for kind in model.geom_type[collides]]
    convex = not _CONVEX.isdisjoint(kinds) or kinds.count(int(mujoco.mjtGeom.mjGEOM_BOX)) > 1
    return _TEMPORARIES_CONVEX if convex or model.opt.noslip_iterations > 0 else _TEMPORARIES


_BITS = mjw.OverflowType

CONTACT_BITS = int(_BITS.BROADPHASE | _BITS.NARROWPHASE)
CONSTRAINT_BITS = int(_BITS.NEFC | _BITS.NJMAX_NNZ | _BITS.NVMAX)
IGNORED_BITS = int(_BITS.ITERATIONS | _BITS.LS_ITERATIONS)
"""Warning bits that are not faults. A solver that reaches its iteration limit still returns a solution."""


def report_pool_overflow(data: mjw.Data, mask: wp.array) -> None:
    """Set the masked worlds' overflow bit if a forward pass found too many contacts.

    ``mujoco_warp.step`` sets the bit itself; ``mujoco_warp.forward`` does not.
    """
    pool = [data.ncollision, data.nacon, data.naconmax, int(_BITS.NARROWPHASE)]
    wp.launch(faults.pool_overflow, data.nworld, [mask, *pool, data.overflow], device=mask.device)
