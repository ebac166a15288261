"""Interpolate plans from spline knots, and move the knots forward in time.

With K knots over a horizon of H steps, the knots are H / K steps apart. They stay fixed in time while the horizon
moves, so the plan keeps the actions of its remaining steps. MuJoCo MPC calls this a sliding plan. Positions are whole
numbers in units of 1 / K steps: knots are H units apart, and steps are K units apart. The phase is the position of the
horizon's first step, measured from the last knot at or before it. It is at least 0 and less than H.
"""

import math

import warp as wp

from lyceum_warp.kernels.rollouts import plant_of

ORDERS = {"zero": 0, "linear": 1, "cubic": 3}
"""Spline orders by name."""

_NEEDED = {"zero": 1, "linear": 2, "cubic": 4}
"""The number of knots that determine an interpolated value."""


def knot_count(horizon: int, knots: int, spline: str) -> int:
    """Return the number of knots that a plan needs at its largest phase."""
    largest_phase = horizon - math.gcd(horizon, knots)
    return ((horizon - 1) * knots + largest_phase) // horizon + _NEEDED[spline]


@wp.kernel(enable_backward=False)
def pass_knots(
    steps_in: wp.array[int], horizon: int, knots: int, phase_inout: wp.array[int], passed_out: wp.array[int]
):
    """Advance each plan's phase by ``steps`` steps, and count the knots that it passes; launched over (nplant,)."""
    p = wp.tid()
    place = wp.int64(phase_inout[p]) + wp.int64(steps_in[p]) * wp.int64(knots)
    passed = place // wp.int64(horizon)
    phase_inout[p] = int(place - passed * wp.int64(horizon))
    passed_out[p] = int(wp.min(passed, wp.int64(2147483647)))


@wp.kernel(enable_backward=False)
def interpolate(
    knot_in: wp.array3d[float],
    phase_in: wp.array[int],
    knots: int,
    order: int,
    low_in: wp.array[float],
    high_in: wp.array[float],
    action_out: wp.array3d[float],
):
    """Interpolate actions between knots and clip them to the bounds; launched over (horizon, nworld, nact).

    The worlds of a sample are consecutive, and so are the samples of a plant. Order 0 holds each knot until the next,
    and order 1 interpolates linearly. Order 3 is a cubic Hermite spline (Catmull and Rom 1974): the slope at a knot is
    half the difference between the next knot and the previous one, so one more knot precedes the grid.
    """
    t, w, i = wp.tid()
    k = w // (action_out.shape[1] // knot_in.shape[1])
    horizon = wp.int64(action_out.shape[0])
    phase = phase_in[plant_of(w, action_out.shape[1], phase_in.shape[0])]
    place = wp.int64(t) * wp.int64(knots) + wp.int64(phase)
    j = int(place // horizon)
    f = float(place - wp.int64(j) * horizon) / float(horizon)
    value = knot_in[j, k, i]
    if order == 1:
        value += f * (knot_in[j + 1, k, i] - value)
    elif order == 3:
        before, here, after = value, knot_in[j + 1, k, i], knot_in[j + 2, k, i]
        slope, next_slope = 0.5 * (after - before), 0.5 * (knot_in[j + 3, k, i] - here)
        rise = after - here
        # here + slope f + (3 rise - 2 slope - next_slope) f^2 + (slope + next_slope - 2 rise) f^3
        bend = 3.0 * rise - 2.0 * slope - next_slope
        value = here + f * (slope + f * (bend + f * (slope + next_slope - 2.0 * rise)))
    action_out[t, w, i] = wp.clamp(value, low_in[i], high_in[i])
