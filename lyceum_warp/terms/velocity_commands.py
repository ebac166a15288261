"""Draw velocity commands at random times: forward velocity, lateral velocity and yaw rate in the base's axes.

A command is stored in several rows of memory, and a separate function fills each row with random numbers::

    terms.draw_timer(s.command_timer, p.command_seconds, rng)
    terms.draw_velocity(s.drawn_velocity, p.command_low, p.command_high, rng)
    terms.draw_heading(s.heading_target, s.heading_controlled, p.heading_share, rng)
    terms.draw_flag(s.standing, p.standing_share, rng)
    terms.draw_forward_only(s.drawn_velocity, p.forward_share, p.least_forward_velocity, rng)

The order of the calls follows ``UniformVelocityCommand`` of mjlab 1.6.0.
"""

import warp as wp

from lyceum_warp.core.task import Row
from lyceum_warp.kernels.random import uniform
from lyceum_warp.terms.draws import chosen


@wp.func
def draw_timer(timer: Row[float], seconds: wp.vec2, rng: Row[wp.uint32]):
    """Set a timer to a random duration, U(seconds[0], seconds[1])."""
    timer[0] = uniform(rng, seconds[0], seconds[1])


@wp.func
def run_timer(timer: Row[float], dt: float):
    """Decrease a timer by dt seconds; call this in ``advance``."""
    timer[0] = timer[0] - dt


@wp.func
def is_due(timer: Row[float]) -> bool:
    """Return whether a timer has run out, with a tolerance of 1e-6 s; call this in ``event``."""
    return timer[0] < 1e-6


@wp.func
def draw_flag(flag: Row[float], share: float, rng: Row[wp.uint32]):
    """Set a flag to 1 with the given probability, and otherwise to 0."""
    flag[0] = wp.where(chosen(rng, share), 1.0, 0.0)


@wp.func
def draw_velocity(drawn_velocity: Row[wp.vec3], command_low: wp.vec3, command_high: wp.vec3, rng: Row[wp.uint32]):
    """Draw forward velocity, lateral velocity and yaw rate, each from its own range."""
    drawn_velocity[0] = uniform(rng, command_low, command_high)


@wp.func
def draw_heading(heading_target: Row[float], heading_controlled: Row[float], heading_share: float, rng: Row[wp.uint32]):
    """Draw a heading from U(-pi, pi), and draw whether the yaw rate follows the heading."""
    heading_target[0] = uniform(rng, -wp.pi, wp.pi)
    draw_flag(heading_controlled, heading_share, rng)


@wp.func
def draw_forward_only(
    drawn_velocity: Row[wp.vec3], forward_share: float, least_forward_velocity: float, rng: Row[wp.uint32]
):
    """With the given probability, replace a drawn velocity by (max(|v_x|, least), 0, 0)."""
    if chosen(rng, forward_share):
        drawn_velocity[0] = wp.vec3(wp.max(wp.abs(drawn_velocity[0][0]), least_forward_velocity), 0.0, 0.0)


@wp.func
def heading_yaw_rate(target_heading: float, heading: float, heading_gain: float, fastest_yaw_rate: float) -> float:
    """Return clip(gain * (target - heading), -fastest, fastest), rad/s; the difference is wrapped to [-pi, pi]."""
    error = target_heading - heading
    return wp.clamp(heading_gain * wp.atan2(wp.sin(error), wp.cos(error)), -fastest_yaw_rate, fastest_yaw_rate)


@wp.func
def velocity_command(
    drawn_velocity: Row[wp.vec3],
    heading_target: Row[float],
    heading_controlled: Row[float],
    standing: Row[float],
    heading: float,
    heading_gain: float,
    fastest_yaw_rate: float,
) -> wp.vec3:
    """Compute the command: 0 for a standing robot, otherwise the drawn velocity.

    If ``heading_controlled`` is 1, the yaw rate follows the heading. Source: mjlab 1.6.0, ``UniformVelocityCommand``.
    """
    if standing[0] > 0.0:
        return wp.vec3(0.0)
    command = drawn_velocity[0]
    if heading_controlled[0] > 0.0:
        command[2] = heading_yaw_rate(heading_target[0], heading, heading_gain, fastest_yaw_rate)
    return command


@wp.func
def command_size(command: wp.vec3) -> float:
    """Return |c_xy| + |c_yaw|, which mjlab 1.6.0 compares with its thresholds."""
    return wp.length(wp.vec2(command[0], command[1])) + wp.abs(command[2])


@wp.func
def active(command: wp.vec3, least_command: float) -> float:
    """Return 1 if the robot should move: its ``command_size`` exceeds ``least_command``. Otherwise, return 0."""
    return wp.where(command_size(command) > least_command, 1.0, 0.0)
