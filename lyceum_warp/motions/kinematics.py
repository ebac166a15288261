"""Compute velocities and body poses of motions, by differences and by MuJoCo's kinematics."""

import hashlib
from typing import NamedTuple

import mujoco
import numpy as np

from lyceum_warp.models import walkers
from lyceum_warp.motions import rotations

_GEOMETRY = ("body_parentid", "body_pos", "body_quat", "jnt_type", "jnt_bodyid", "jnt_pos", "jnt_axis", "qpos0")
"""Fields of a model on which the poses of its bodies depend."""


class Reference(NamedTuple):
    """The velocities of a motion, and the poses and velocities of bodies, one row per frame."""

    qvel: np.ndarray
    """(frames, nv)."""
    positions: np.ndarray
    """(frames, bodies, 3), m."""
    rotations: np.ndarray
    """(frames, bodies, 4)."""
    velocities: np.ndarray
    """Of the bodies' origins in the world's axes, (frames, bodies, 3), m/s."""
    spins: np.ndarray
    """Angular velocities in the world's axes, (frames, bodies, 3), rad/s."""


def reference_of(model: mujoco.MjModel, qpos: np.ndarray, dt: float) -> Reference:
    """Differentiate the coordinates of a robot with a free joint and hinges, and move all of its bodies."""
    spin = rotations.angular_velocity(qpos[:, 3:7], dt)
    local = rotations.rotate(rotations.inverse(qpos[:, 3:7]), spin)
    qvel = np.hstack([np.gradient(qpos[:, :3], dt, axis=0), local, np.gradient(qpos[:, 7:], dt, axis=0)])
    data, frames = mujoco.MjData(model), list[tuple[np.ndarray, ...]]()
    for i in range(len(qpos)):
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        # MuJoCo's velocities are those at the centre of mass of the kinematic tree
        arms = data.xpos - data.subtree_com[model.body_rootid]
        velocities = data.cvel[:, 3:] + np.cross(data.cvel[:, :3], arms)
        frames.append((data.xpos.copy(), data.xquat.copy(), velocities, data.cvel[:, :3].copy()))
    return Reference(qvel, *map(np.array, zip(*frames, strict=True)))


_references: dict[bytes, Reference] = {}


def references(model: mujoco.MjModel, clips: np.ndarray, bodies: np.ndarray, dt: float) -> Reference:
    """Compute the motions of a table of clips (see ``Clips``) for some bodies. The last two results are kept."""
    parts = (clips, bodies, np.array(dt), *(getattr(model, name) for name in _GEOMETRY))
    key = hashlib.blake2b(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).digest()
    if (reference := _references.get(key)) is None:
        if len(_references) > 1:
            _references.pop(next(iter(_references)), None)
        columns = []
        for first, count in ranges(clips):
            qpos = np.asarray(clips[first : first + count, 2:], float)
            qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
            qvel, *poses = reference_of(model, qpos, dt)
            columns.append((qvel, *(part[:, bodies] for part in poses)))
        tables = (np.concatenate(parts).astype(np.float32) for parts in zip(*columns, strict=True))
        reference = _references[key] = Reference(*tables)
    return reference


def ranges(clips: np.ndarray) -> np.ndarray:
    """Find the first row and the number of rows of each clip in a table, (clips, 2)."""
    starts = np.flatnonzero(clips[:, 0] == 0.0)
    return np.stack([starts, np.diff(starts, append=len(clips))], axis=1)


def contact_spheres(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """List spheres that cover the geoms that can touch the ground: their bodies, and centres and radii (spheres, 4)."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    bodies, spheres = [], [np.zeros((0, 4))]
    for body in range(1, model.nbody):
        for geom in walkers.contact_geoms(model, body):
            one = walkers.spheres_of(model, data, geom)
            one[:, :3] = (one[:, :3] - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
            bodies += len(one) * [body]
            spheres.append(one)
    return np.array(bodies, int), np.concatenate(spheres)
