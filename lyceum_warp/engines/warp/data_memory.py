"""An estimate of the memory that MuJoCo Warp takes for each world."""

import dataclasses
from typing import Any

import mujoco
import mujoco_warp as mjw
import warp as wp

_TEMPORARIES = 1.25
"""Ratio of a world's memory to that of MuJoCo Warp's data. The temporary arrays of a step were measured at 1 to 9 % of
it; the rest is for graphs and for the group of a partial forward pass. Graphs on the CPU, where this engine is for
tests, keep all temporary arrays and take up to three times as much."""

_TEMPORARIES_CONVEX = 3.5
"""The same with convex collisions or the noslip solver: on adroit_pen the temporary arrays take 1.5 to 2.4 times the
memory of the data."""

_CONVEX = {mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_MESH,
           mujoco.mjtGeom.mjGEOM_HFIELD}  # fmt: skip


def data_bytes(model: mujoco.MjModel, nconmax: int, njmax: int) -> int:
    """Bytes of each world's data, temporary arrays included, for so many contacts and constraints in each world."""
    sizes = []
    for nworld in (1, 2):
        with wp.ScopedDevice("cpu"):
            data = mjw.make_data(model, nworld=nworld, naconmax=nworld * nconmax, njmax=njmax)
        sizes.append(_bytes_of(data))
    return int(_margin(model) * (sizes[1] - sizes[0]))


def _bytes_of(data: Any) -> int:
    """Bytes of all arrays in a data class and in those within it."""
    total = 0
    for field in dataclasses.fields(data):
        value = getattr(data, field.name)
        if isinstance(value, wp.array):
            total += value.size * wp.types.type_size_in_bytes(value.dtype)
        elif dataclasses.is_dataclass(value):
            total += _bytes_of(value)
    return total


def _margin(model: mujoco.MjModel) -> float:
    """Ratio of a world's memory to that of its data; larger with convex collisions or the noslip solver."""
    collides = (model.geom_contype | model.geom_conaffinity) != 0
    kinds = [int(kind) for kind in model.geom_type[collides]]
    convex = not _CONVEX.isdisjoint(kinds) or kinds.count(int(mujoco.mjtGeom.mjGEOM_BOX)) > 1
    return _TEMPORARIES_CONVEX if convex or model.opt.noslip_iterations > 0 else _TEMPORARIES
