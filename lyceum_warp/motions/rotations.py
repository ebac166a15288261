"""Compute with arrays of unit quaternions (..., 4) in MuJoCo's order w, x, y, z."""

import numpy as np


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Multiply quaternions: the rotation by ``b``, followed by the rotation by ``a``."""
    w = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    v = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([w, v], axis=-1)


def inverse(q: np.ndarray) -> np.ndarray:
    """Invert rotations."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Rotate vectors (..., 3)."""
    u = q[..., 1:]
    return v + 2.0 * np.cross(u, q[..., :1] * v + np.cross(u, v))


def to_rotvec(q: np.ndarray) -> np.ndarray:
    """Convert rotations to axis times angle, (..., 3), with angles from 0 to pi rad."""
    q = np.where(q[..., :1] < 0.0, -q, q)
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., :1])
    return q[..., 1:] * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0.0)


def from_rotvec(r: np.ndarray) -> np.ndarray:
    """Make rotations from axis times angle, (..., 3), in rad."""
    angle = np.linalg.norm(r, axis=-1, keepdims=True)
    return np.concatenate([np.cos(0.5 * angle), 0.5 * np.sinc(0.5 * angle / np.pi) * r], axis=-1)


def interpolate(a: np.ndarray, b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Move from rotations ``a`` towards ``b`` at constant speed on the shortest way (slerp); share is (...,)."""
    return multiply(a, from_rotvec(share[..., None] * to_rotvec(multiply(inverse(a), b))))


def yaw(q: np.ndarray) -> np.ndarray:
    """Return the angle of the rotation about z that is nearest to each rotation, (...,), in rad."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def angular_velocity(q: np.ndarray, dt: float) -> np.ndarray:
    """Differentiate rotations (frames, ..., 4) in SO(3): the angular velocity in the world's axes, (frames, ..., 3).

    The result is log(q_{i+1} q_{i-1}^-1) / 2 dt. The first and the last frame repeat their neighbour's, as in mjlab.
    """
    inner = to_rotvec(multiply(q[2:], inverse(q[:-2]))) / (2.0 * dt)
    return np.concatenate([inner[:1], inner, inner[-1:]])
