"""Provide Warp functions for rewards and terminations: tolerances, sums of squares and bounds."""

import enum
from typing import Any

import warp as wp


class Sigmoid(enum.IntEnum):
    """The curves along which ``tolerance`` decreases from 1 towards 0, as in dm_control's ``rewards.py``."""

    GAUSSIAN = 0
    HYPERBOLIC = 1
    LONG_TAIL = 2
    RECIPROCAL = 3
    COSINE = 4
    LINEAR = 5
    QUADRATIC = 6
    TANH_SQUARED = 7


@wp.func
def tolerance(
    x: float,
    bounds: wp.vec2,
    margin: float = 0.0,
    sigmoid: int = int(Sigmoid.GAUSSIAN),
    value_at_margin: float = 0.1,
) -> float:
    """Return 1 within bounds, and a number that falls towards 0 outside them, as dm_control's ``tolerance`` does.

    In this table, v is ``value_at_margin``, and d is the distance from the nearer bound divided by the margin:

    ============  =======================================  =================
    GAUSSIAN      exp(-(d s)^2 / 2), s = sqrt(-2 log v)    0 < v < 1
    HYPERBOLIC    1 / cosh(d s), s = arccosh(1 / v)        0 < v < 1
    LONG_TAIL     1 / ((d s)^2 + 1), s = sqrt(1 / v - 1)   0 < v < 1
    RECIPROCAL    1 / (d s + 1), s = 1 / v - 1             0 < v < 1
    COSINE        (1 + cos(pi d s)) / 2 if d s < 1, or 0   0 <= v < 1, s = arccos(2 v - 1) / pi
    LINEAR        max(0, 1 - d s), s = 1 - v               0 <= v < 1
    QUADRATIC     max(0, 1 - (d s)^2), s^2 = 1 - v         0 <= v < 1
    TANH_SQUARED  1 - tanh(d s)^2, s = arctanh(sqrt(1-v))  0 < v < 1
    ============  =======================================  =================

    Args:
        x: The number.
        bounds: The result is 1 if x lies between these two numbers. Both may be infinite.
        margin: The distance from the bounds at which the result is ``value_at_margin``. If it is 0, the result is 0
            everywhere outside the bounds.
        sigmoid: The shape of the curve outside the bounds, an ``lw.Sigmoid``.
        value_at_margin: The result at the margin.
    """
    outside = wp.max(bounds[0] - x, x - bounds[1])
    if outside <= 0.0:
        return 1.0
    if margin <= 0.0:
        return 0.0
    d, v = outside / margin, value_at_margin
    if sigmoid == wp.static(int(Sigmoid.GAUSSIAN)):
        return wp.exp(d * d * wp.log(v))
    if sigmoid == wp.static(int(Sigmoid.HYPERBOLIC)):
        # arccosh(y) = log(y + sqrt(y^2 - 1))
        return 1.0 / wp.cosh(d * wp.log(1.0 / v + wp.sqrt(1.0 / (v * v) - 1.0)))
    if sigmoid == wp.static(int(Sigmoid.LONG_TAIL)):
        return 1.0 / (d * d * (1.0 / v - 1.0) + 1.0)
    if sigmoid == wp.static(int(Sigmoid.RECIPROCAL)):
        return 1.0 / (d * (1.0 / v - 1.0) + 1.0)
    if sigmoid == wp.static(int(Sigmoid.COSINE)):
        scaled = d * wp.acos(2.0 * v - 1.0)
        return wp.where(scaled < wp.pi, 0.5 * (1.0 + wp.cos(scaled)), 0.0)
    if sigmoid == wp.static(int(Sigmoid.LINEAR)):
        return wp.max(0.0, 1.0 - d * (1.0 - v))
    if sigmoid == wp.static(int(Sigmoid.QUADRATIC)):
        return wp.max(0.0, 1.0 - d * d * (1.0 - v))
    # arctanh(y) = log((1 + y) / (1 - y)) / 2
    root = wp.sqrt(1.0 - v)
    t = wp.tanh(0.5 * d * wp.log((1.0 + root) / (1.0 - root)))
    return 1.0 - t * t


@wp.func
def grasp_terms(distance: float, finger: float, closed: float) -> tuple[float, float, float]:
    """Return the reward terms ``near, reach, grasp`` for grasping with two fingers, each from 0 to 1.

    ``near`` is 1 up to 1 cm from the target and 0.1 at 2 cm; ``reach`` falls slowly, to 0.2 at 10.5 cm. ``grasp`` is
    0.5 if the fingers are far from the target and open, 1 if they are near and closed, and otherwise 0.

    Args:
        distance: Distance from the point between the fingers to the target, m.
        finger: Position of a finger, m; it is 0 if the fingers meet.
        closed: Largest position at which the fingers count as closed, m. Above ``closed`` + 2.2 cm, the fingers
            count as open.
    """
    near = tolerance(distance, wp.vec2(0.0, 0.01), 0.01)
    reach = tolerance(distance, wp.vec2(0.0, 0.005), 0.1, int(Sigmoid.RECIPROCAL), 0.2)
    shut = tolerance(finger, wp.vec2(0.0, closed), 0.02, int(Sigmoid.LINEAR))
    return near, reach, near * shut + 0.5 * (1.0 - near) * (1.0 - shut)


@wp.func
def sum_squares(row: wp.array[float], first: int, last: int) -> float:
    total = float(0.0)
    for i in range(first, last):
        total += row[i] * row[i]
    return total


@wp.func
def sum_squares(row: wp.array[Any], first: int, last: int) -> float:
    total = float(0.0)
    for i in range(first, last):
        total += wp.dot(row[i], row[i])
    return total


@wp.func
def sum_squares(row: wp.array[float]) -> float:
    return sum_squares(row, 0, row.shape[0])


@wp.func
def sum_squares(row: wp.array[Any]) -> float:
    """Sum the squares of a row's elements, which are numbers or vectors.

    ``sum_squares(row, first, last)`` sums only those with first <= i < last.
    """
    return sum_squares(row, 0, row.shape[0])


@wp.func
def inside(x: float, bounds: wp.vec2) -> bool:
    """Return whether a number is strictly between two bounds, (low, high); False for NaN."""
    return bounds[0] < x and x < bounds[1]


@wp.func
def all_inside(row: wp.array[float], first: int, last: int, bounds: wp.vec2) -> bool:
    """Return whether all elements of a row with first <= i < last are strictly between two bounds, (low, high)."""
    ok = bool(True)
    for i in range(first, last):
        ok = ok and inside(row[i], bounds)
    return ok
