"""Provide reward terms, commands, contact times, noise, random draws and motors that all tasks can use.

Every function is a ``wp.func``. Its arguments are numbers, vectors, rows of ``World`` and tables of ``Params``. An
argument's name has the same meaning in all functions:

    action: the action of the step
    active: 1 if the robot should move, else 0; see the function ``active``
    actuator_biasprm: the model field
    actuator_gainprm: the model field
    actuators: array of Params: indices of actuators
    age: age of a value in a history: the number of newer values
    air_time: row of memory: seconds since each foot left the ground (0 in contact)
    angular_velocity: angular velocity of the base in the base's axes (rad/s)
    angular_velocity_variance: squared error at which the term is 1 / e (rad^2/s^2)
    at: index of the first number
    base_height: height of the base's origin in the world (m)
    bodies: array of Params: indices of bodies
    body: index of a body
    body_inertia: the model field
    body_ipos: the model field
    body_mass: the model field
    command: forward and lateral velocity (m/s) and yaw rate (rad/s), in the base's axes
    command_high: greatest forward and lateral velocity (m/s) and yaw rate (rad/s)
    command_low: least forward and lateral velocity (m/s) and yaw rate (rad/s)
    contact_seconds: the ``contact_time`` of one foot
    contact_time: row of memory: seconds since each foot touched down (0 in the air)
    default_pose: array of Params: default position of each joint (rad)
    delay: row of memory with 1 number: a delay in steps
    drawn_velocity: row of memory with 1 vector: the drawn command
    dt: seconds in a step
    earlier_action: row of memory: the action two steps ago
    effort_limit: greatest continuous torque of a motor (N m)
    encoder_bias: row of memory: error of each joint's encoder (rad)
    fall_angle: greatest tilt (rad)
    fastest_yaw_rate: greatest yaw rate (rad/s)
    feet: array of Params: indices of the feet's sites
    flag: row of memory with 1 number, which is 1 or 0
    foot: index of a foot, from 0
    foot_forces: array of Params: indices in ``sensordata`` of the contact force on each foot (N)
    foot_height: height of a foot above the ground (m)
    foot_velocities: array of Params: indices in ``sensordata`` of each foot's velocity in the world's axes (m/s)
    foot_velocity: velocity of a foot in the world's axes (m/s)
    forward_share: probability of a command to walk straight ahead
    geom_friction: the model field
    geoms: array of Params: indices of geoms
    gravity: direction of gravity in the base's axes, a unit vector
    heading: angle of the base about the world's z axis (rad)
    heading_controlled: row of memory with 1 number, which is 1 if the yaw rate follows the heading
    heading_gain: ratio of the yaw rate to the error of the heading (1/s)
    heading_share: probability that the yaw rate follows the heading
    heading_target: row of memory with 1 number: the commanded heading (rad)
    high: upper end of the range
    history: row of memory with 1 + n * width numbers: the last n values
    i: index in a value
    indices: array of Params: indices of elements
    jnt_range: the model field
    joint_dof: array of Params: index of each joint in ``qvel``
    joint_position: position of a joint (rad)
    joint_qpos: array of Params: index of each joint in ``qpos``
    joint_target: target of a joint (rad)
    joint_velocity: velocity of a joint (rad/s)
    joints: array of Params: index of each joint in the ``jnt_`` fields
    kd: damping of a servo (N m s/rad)
    kd_scale: range of the factors of kd
    kp: stiffness of a servo (N m/rad)
    kp_scale: range of the factors of kp
    least: smallest integer
    least_command: ``command_size`` above which the robot should move
    least_forward_velocity: smallest velocity of a command to walk straight ahead (m/s)
    least_height: least height of the base (m)
    linear_velocity: velocity of the base's origin in the base's axes (m/s)
    linear_velocity_variance: squared error at which the term is 1 / e (m^2/s^2)
    low: lower end of the range
    most: largest integer
    noise: bound of uniform noise, or standard deviation of normal noise
    offset: bounds of the offset (m)
    peak_height: row of memory: greatest height of each foot since its last landing (m)
    pose_std: array of Params: standard deviation of each joint (rad)
    previous_action: row of memory: the action one step ago
    push_spin: bounds of the change of angular velocity, in the world's axes (rad/s)
    push_velocity: bounds of the change of velocity, in the world's axes (m/s)
    qacc: the field after the last substep
    qfrc_actuator: the field after the last substep
    qpos: the field
    qvel: the field
    rng: the world's random stream
    rolling_friction: range of the rolling friction
    row: the row
    saturation_torque: torque of a motor at rest (N m)
    scale: range of the factors
    seconds: range of the duration (s)
    sensordata: the field
    share: probability
    site_xpos: the field
    sliding_friction: range of the sliding friction
    soft_limit: fraction of a joint's range that has no cost, around the middle of the range
    source: the row to read
    spinning_friction: range of the spinning friction
    standing: row of memory with 1 number, which is 1 if the robot should stand
    standing_pose_std: array of Params: standard deviation of each joint while standing (rad)
    substep_dt: seconds in a substep
    swing_height: row of memory: greatest height of each foot in its last swing (m)
    swing_target: desired height of a foot in its swing (m)
    target: the row to write
    target_heading: the commanded heading (rad)
    target_height: desired height of the base (m)
    tilt_variance: squared sine of the tilt at which the term is 1 / e
    timer: row of memory with 1 number: the seconds left
    torque: desired torque (N m)
    touching: whether the foot touches the ground
    value: the row to append
    velocity: velocity in the world's axes (m/s)
    velocity_limit: no-load speed of a motor (rad/s)
    walking_pose_std: array of Params: standard deviation of each joint while walking (rad)
    width: number of elements of one value in a history
"""

import inspect

from lyceum_warp.support.docstrings import listed
from lyceum_warp.support.faces import face

__getattr__, __dir__, __all__ = face(__name__)

ARGUMENTS = dict(line.strip().split(": ", 1) for line in str(__doc__).splitlines() if line.startswith("    "))
"""The meanings of arguments by name, from the list above."""

for _function in map(__getattr__, __all__):
    _overloads = (*_function.user_overloads.values(), *_function.user_templates.values())
    _names = dict.fromkeys(name for overload in _overloads for name in overload.input_types)
    if _names:
        _text = listed({name: ARGUMENTS[name] for name in _names})
        _function.__doc__ = f"{inspect.cleandoc(_function.__doc__)}\n\nArgs:\n{_text}\n"
