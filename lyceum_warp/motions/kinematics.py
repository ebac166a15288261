"""Compute velocities and body poses of motions, by differences and by MuJoCo's kinematics."""

import dataclasses
import functools
import hashlib
from typing import Any

import mujoco
import numpy as np

from lyceum_warp.models import walkers
from lyceum_warp.motions import rotations

_GEOMETRY = ("body_parentid", "body_pos", "body_quat", "jnt_type", "jnt_bodyid", "jnt_pos", "jnt_axis", "qpos0")
"""Fields of a model on which the poses of its bodies depend."""


def body_poses(model: mujoco.MjModel, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the positions (frames, nbody, 3) and rotations (frames, nbody, 4) of all bodies."""
    data = mujoco.MjData(model)
    positions, turns = np.empty((len(qpos), model.nbody, 3)), np.empty((len(qpos), model.nbody, 4))
    for i, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        positions[i], turns[i] = data.xpos, data.xquat
    return positions, turns


def body_velocities(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the velocities and the angular velocities of all bodies, each (frames, nbody, 3).

    The velocities are those of the bodies' origins. Both have the world's axes.
    """
    data = mujoco.MjData(model)
    velocities, spins = np.empty((len(qpos), model.nbody, 3)), np.empty((len(qpos), model.nbody, 3))
    for i in range(len(qpos)):
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        spins[i] = data.cvel[:, :3]
        # MuJoCo's velocities are those at the centre of mass of the kinematic tree
        arms = data.xpos - data.subtree_com[model.body_rootid]
        velocities[i] = data.cvel[:, 3:] + np.cross(spins[i], arms)
    return velocities, spins


def joint_velocities(qpos: np.ndarray, dt: float) -> np.ndarray:
    """Differentiate coordinates: ``qvel`` of a robot with a free joint and hinges, (frames, nv)."""
    spin = rotations.angular_velocity(qpos[:, 3:7], dt)
    local = rotations.rotate(rotations.inverse(qpos[:, 3:7]), spin)
    return np.hstack([np.gradient(qpos[:, :3], dt, axis=0), local, np.gradient(qpos[:, 7:], dt, axis=0)])


@dataclasses.dataclass(frozen=True)
class References:
    """Reference motions of all clips, one row per frame."""

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


def references(model: mujoco.MjModel, clips: np.ndarray, bodies: Any, dt: float) -> References:
    """Compute the reference motions of a table of clips (see ``Clips``) for some bodies. Results are cached."""
    geometry = [np.asarray(getattr(model, name)) for name in _GEOMETRY]
    key = hashlib.blake2b(b"".join(np.ascontiguousarray(part).tobytes() for part in (clips, *geometry))).digest()
    return _cached(key, tuple(int(body) for body in bodies), dt, _Inputs(model, clips))


class _Inputs:
    """The arguments of ``_cached`` that its key stands for: all instances are equal."""

    def __init__(self, model: mujoco.MjModel, clips: np.ndarray) -> None:
        self.model, self.clips = model, clips

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Inputs)

    def __hash__(self) -> int:
        return 0


@functools.lru_cache(maxsize=2)
def _cached(key: bytes, bodies: tuple[int, ...], dt: float, inputs: _Inputs) -> References:
    columns: list[tuple[np.ndarray, ...]] = []
    for first, count in ranges(inputs.clips):
        qpos = np.asarray(inputs.clips[first : first + count, 2:], float)
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        qvel = joint_velocities(qpos, dt)
        parts = *body_poses(inputs.model, qpos), *body_velocities(inputs.model, qpos, qvel)
        columns.append((qvel, *(part[:, list(bodies)] for part in parts)))
    return References(*(np.concatenate(parts).astype(np.float32) for parts in zip(*columns, strict=True)))


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
