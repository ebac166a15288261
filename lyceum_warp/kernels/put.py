"""Provide Warp functions that write values into rows, such as observations and coordinates."""

from typing import Any

import warp as wp

from lyceum_warp.kernels.rotations import quat_from_axis_angle


@wp.func
def put(row: wp.array[float], at: int, value: float) -> int:
    row[at] = value
    return at + 1


@wp.func
def put(row: wp.array[float], at: int, value: int) -> int:
    return put(row, at, float(value))


@wp.func
def put(row: wp.array[float], at: int, value: bool) -> int:
    return put(row, at, wp.where(value, 1.0, 0.0))


@wp.func
def put(row: wp.array[float], at: int, value: wp.mat33) -> int:
    for i in range(3):
        for j in range(3):
            row[at + 3 * i + j] = value[i, j]
    return at + 9


@wp.func
def put(row: wp.array[float], at: int, value: wp.array[float], first: int, last: int) -> int:
    for i in range(first, last):
        row[at + i - first] = value[i]
    return at + last - first


@wp.func
def put(row: wp.array[float], at: int, value: wp.array[float]) -> int:
    return put(row, at, value, 0, value.shape[0])


@wp.func
def put(row: wp.array[float], at: int, value: wp.array[Any], first: int, last: int) -> int:
    k = int(at)
    for i in range(first, last):
        k = put(row, k, value[i])
    return k


@wp.func
def put(row: wp.array[float], at: int, value: wp.array[Any]) -> int:
    return put(row, at, value, 0, value.shape[0])


# keep this overload last: it fits every type, and Warp uses the first overload that fits
@wp.func
def put(row: wp.array[float], at: int, value: Any) -> int:
    """Write a value into a row, starting at the index ``at``, and return the next index.

    The value is a number, a bool, a vector, a matrix (row by row), or a row of any of these. From a row,
    ``put(row, at, value, first, last)`` writes the elements with first <= i < last. Chain calls to write an
    observation: ``k = lw.put(obs, 0, s.qpos)``, then ``k = lw.put(obs, k, s.qvel)``.
    """
    for i in range(len(value)):
        row[at + i] = value[i]
    return at + len(value)


@wp.func
def put_upright(qpos: wp.array[float], at: int, position: wp.vec3, yaw: float) -> int:
    """Write the pose of an upright body into the coordinates of its free joint, and return the next index.

    Args:
        qpos: The coordinates of a world.
        at: Index of the joint's first coordinate, from ``lw.qpos``.
        position: Position of the body, m.
        yaw: Rotation of the body about the vertical axis z, rad.
    """
    k = put(qpos, at, position)
    return put(qpos, k, quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), yaw))
