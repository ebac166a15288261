"""Measure how long feet are in contact, and compute reward terms for swings, slips and landings.

The tables ``feet`` (sites), ``foot_velocities`` and ``foot_forces`` (sensors) must list the feet in the same order.
Call ``run_clocks`` in ``substep``, and ``follow_swing`` in ``advance``. Heights are measured from the plane z = 0. On
uneven ground, a task must measure the heights itself and sum ``clearance`` over the feet.
"""

import warp as wp

from lyceum_warp.core.task import Row


@wp.func
def sensor_vector(sensordata: Row[float], at: int) -> wp.vec3:
    """Return the three numbers of a sensor; ``lw.sensor`` gives the index of the first."""
    return wp.vec3(sensordata[at], sensordata[at + 1], sensordata[at + 2])


@wp.func
def ground_speed(velocity: wp.vec3) -> float:
    """Return the horizontal speed |v_xy|, m/s."""
    return wp.length(wp.vec2(velocity[0], velocity[1]))


@wp.func
def run_clocks(foot: int, touching: bool, contact_time: Row[float], air_time: Row[float], substep_dt: float):
    """Advance a foot's contact time or air time by a substep, and set the other to 0.

    Source: mjlab 1.6.0, ``ContactSensor``.
    """
    contact_time[foot] = wp.where(touching, contact_time[foot] + substep_dt, 0.0)
    air_time[foot] = wp.where(touching, 0.0, air_time[foot] + substep_dt)


@wp.func
def landed(contact_seconds: float, dt: float) -> bool:
    """Return whether a contact began in the last step: 0 < seconds < dt, with a tolerance of 1e-6 s.

    Source: mjlab 1.6.0, ``compute_first_contact``.
    """
    return contact_seconds > 0.0 and contact_seconds < dt + 1e-6


@wp.func
def follow_swing(
    foot: int,
    foot_height: float,
    contact_time: Row[float],
    peak_height: Row[float],
    swing_height: Row[float],
    dt: float,
):
    """Track the greatest height of a foot's swing in ``peak_height``.

    When the foot lands, store this height in ``swing_height``, and reset ``peak_height`` to 0.
    """
    if landed(contact_time[foot], dt):
        swing_height[foot] = peak_height[foot]
        peak_height[foot] = 0.0
    elif contact_time[foot] == 0.0:
        peak_height[foot] = wp.max(peak_height[foot], foot_height)


@wp.func
def clearance(foot_height: float, foot_velocity: wp.vec3, swing_target: float) -> float:
    """Return |height - target| |v_xy| of one foot: a fast foot should be near its target height."""
    return wp.abs(foot_height - swing_target) * ground_speed(foot_velocity)


@wp.func
def foot_clearance(
    site_xpos: Row[wp.vec3],
    feet: wp.array[int],
    sensordata: Row[float],
    foot_velocities: wp.array[int],
    swing_target: float,
    active: float,
) -> float:
    """Return the sum of ``clearance`` over the feet, times ``active``, m^2/s.

    Source: mjlab 1.6.0, ``feet_clearance``.
    """
    total = float(0.0)
    for foot in range(feet.shape[0]):
        velocity = sensor_vector(sensordata, foot_velocities[foot])
        total += clearance(site_xpos[feet[foot]][2], velocity, swing_target)
    return active * total


@wp.func
def foot_slip(sensordata: Row[float], foot_velocities: wp.array[int], contact_time: Row[float], active: float) -> float:
    """Return the sum of |v_xy|^2 over the feet in contact, times ``active``, (m/s)^2.

    Source: mjlab 1.6.0, ``feet_slip``.
    """
    total = float(0.0)
    for foot in range(foot_velocities.shape[0]):
        if contact_time[foot] > 0.0:
            speed = ground_speed(sensor_vector(sensordata, foot_velocities[foot]))
            total += speed * speed
    return active * total


@wp.func
def foot_swing_height(
    contact_time: Row[float], swing_height: Row[float], swing_target: float, dt: float, active: float
) -> float:
    """Return the sum of (height / target - 1)^2 over the feet that have ``landed``, times ``active``.

    The height is the foot's peak height during the last swing. Source: mjlab 1.6.0, ``feet_swing_height``.
    """
    total = float(0.0)
    for foot in range(contact_time.shape[0]):
        if landed(contact_time[foot], dt):
            error = swing_height[foot] / swing_target - 1.0
            total += error * error
    return active * total


@wp.func
def soft_landing(
    contact_time: Row[float],
    sensordata: Row[float],
    foot_forces: wp.array[int],
    dt: float,
    substep_dt: float,
    active: float,
) -> float:
    """Return the sum of |force| over the feet that have just landed, times ``active``, N.

    The sensors hold the forces at the start of the last substep. Only feet that had ``landed`` at that time count.
    Source: mjlab 1.6.0, ``soft_landing``.
    """
    total = float(0.0)
    for foot in range(foot_forces.shape[0]):
        if landed(contact_time[foot] - substep_dt, dt):
            total += wp.length(sensor_vector(sensordata, foot_forces[foot]))
    return active * total
