import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from term_calls import N, call

RNG = np.random.default_rng(0)
JOINTS, FEET, DT, SUBSTEP = 5, 4, 0.02, 0.005


def normal(*shape: int, size: float = 1.0) -> np.ndarray:
    return size * RNG.standard_normal((N, *shape))


def unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def clocks(steps: int) -> np.ndarray:
    """Draw random substep counts, half of which are 0."""
    return SUBSTEP * RNG.integers(1, steps, (N, FEET)) * RNG.integers(0, 2, (N, FEET))


QPOS = normal(7 + 2 * JOINTS)
QPOS[:, 3:7] = unit(QPOS[:, 3:7])
COMMAND = normal(3) * RNG.choice([0.01, 0.5, 2.0], (N, 1))
JNT_RANGE = np.sort(normal(1 + JOINTS, 2), axis=2)
VALUES: dict[str, Any] = {
    "action": normal(6), "previous_action": normal(6), "earlier_action": normal(6),
    "active": RNG.integers(0, 2, N),
    "contact_time": clocks(8), "contact_seconds": np.abs(clocks(8)[:, 0]),
    "swing_height": np.abs(normal(FEET, size=0.1)),
    "at": 2, "angular_velocity": normal(3), "linear_velocity": normal(3), "velocity": normal(3),
    "angular_velocity_variance": 0.5, "linear_velocity_variance": 0.25, "tilt_variance": 0.2,
    "base_height": normal(), "target_height": 0.3, "least_height": 0.2, "foot_height": np.abs(normal()),
    "command": COMMAND, "least_command": 0.05,
    "default_pose": normal(JOINTS), "pose_std": 0.5 + np.arange(JOINTS), "standing_pose_std": 1.0 + np.arange(JOINTS),
    "walking_pose_std": 2.0 + np.arange(JOINTS),
    "dt": DT, "substep_dt": SUBSTEP, "fall_angle": 1.2,
    "effort_limit": 1.5, "saturation_torque": 2.0, "velocity_limit": 3.0, "torque": normal(size=3.0),
    "kp": 3.0, "kd": 0.2, "joint_target": normal(), "joint_position": normal(), "joint_velocity": normal(size=4.0),
    "feet": [5, 0, 3, 2], "foot_velocities": [0, 3, 9, 6], "foot_forces": [12, 15, 18, 21], "foot_velocity": normal(3),
    "gravity": unit(normal(3)), "heading": normal(size=3.0), "target_heading": normal(size=3.0), "heading_gain": 0.5,
    "fastest_yaw_rate": 0.6, "indices": [4, 0, 2],
    "jnt_range": JNT_RANGE, "joints": [1, 2, 3, 4, 5], "soft_limit": 0.8,
    "joint_qpos": [8, 7, 10, 14, 12], "joint_dof": [6, 9, 7, 8, 11],
    "swing_target": 0.1,
    "qpos": QPOS, "qvel": normal(12), "qacc": normal(12), "qfrc_actuator": normal(12), "row": normal(6),
    "sensordata": normal(24), "site_xpos": normal(6, 3),
}  # fmt: skip
"""The value of each argument: one shared value, or one entry per world."""


def total(rows: np.ndarray) -> np.ndarray:
    return rows.sum(axis=1)


def matrix(qpos: np.ndarray) -> np.ndarray:
    w, x, y, z = qpos[:, 3:7].T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def size(command: np.ndarray) -> np.ndarray:
    return np.hypot(command[:, 0], command[:, 1]) + np.abs(command[:, 2])


def planar(command: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    return np.hypot(command[:, 0] - velocity[:, 0], command[:, 1] - velocity[:, 1])


def posture(qpos: np.ndarray, joint_qpos: Any, default_pose: np.ndarray, std: np.ndarray) -> np.ndarray:
    return np.exp(-np.square((qpos[:, joint_qpos] - default_pose) / std).mean(axis=1))


def vectors(sensordata: np.ndarray, at: Any) -> np.ndarray:
    return np.stack([sensordata[:, i : i + 3] for i in at], axis=1)


def speeds(sensordata: np.ndarray, at: Any) -> np.ndarray:
    return np.linalg.norm(vectors(sensordata, at)[..., :2], axis=2)


def limits(qpos: np.ndarray, joint_qpos: Any, jnt_range: np.ndarray, joints: Any, soft_limit: float) -> np.ndarray:
    low, high = np.moveaxis(jnt_range[:, joints], 2, 0)
    spare = (1 - soft_limit) * (high - low) / 2
    q = qpos[:, joint_qpos]
    return total(np.maximum(low + spare - q, 0.0) + np.maximum(q - high + spare, 0.0))


def motor(
    torque: Any, joint_velocity: Any, saturation_torque: float, velocity_limit: float, effort_limit: float
) -> Any:
    corner = velocity_limit * (1 + effort_limit / saturation_torque)
    v = np.clip(joint_velocity, -corner, corner) / velocity_limit
    low = np.maximum(saturation_torque * (-1 - v), -effort_limit)
    return np.clip(torque, low, np.minimum(saturation_torque * (1 - v), effort_limit))


def soft(contact_time: Any, sensordata: Any, foot_forces: Any, dt: float, substep_dt: float, active: Any) -> Any:
    younger = np.round((contact_time - substep_dt) / substep_dt)
    hits = (younger > 0) & (younger <= round(dt / substep_dt))
    return active * total(hits * np.linalg.norm(vectors(sensordata, foot_forces), axis=2))


FORMULAS: dict[str, Callable[..., Any]] = {
    # the base
    "orientation": lambda qpos: qpos[:, 3:7],
    "gravity": lambda qpos: -matrix(qpos)[:, 2],
    "linear_velocity": lambda qpos, qvel: np.einsum("nij,ni->nj", matrix(qpos), qvel[:, :3]),
    "angular_velocity": lambda qvel: qvel[:, 3:6],
    "base_height": lambda qpos: qpos[:, 2],
    "heading": lambda qpos: np.arctan2(matrix(qpos)[:, 1, 0], matrix(qpos)[:, 0, 0]),
    "track_linear_velocity": lambda command, linear_velocity, linear_velocity_variance: np.exp(
        -(planar(command, linear_velocity) ** 2 + linear_velocity[:, 2] ** 2) / linear_velocity_variance
    ),
    "track_angular_velocity": lambda command, angular_velocity, angular_velocity_variance: np.exp(
        -((command[:, 2] - angular_velocity[:, 2]) ** 2 + total(angular_velocity[:, :2] ** 2))
        / angular_velocity_variance
    ),
    "velocity_error": lambda command, linear_velocity: planar(command, linear_velocity),
    "yaw_rate_error": lambda command, angular_velocity: np.abs(command[:, 2] - angular_velocity[:, 2]),
    "vertical_velocity_l2": lambda linear_velocity: linear_velocity[:, 2] ** 2,
    "roll_pitch_rate_l2": lambda angular_velocity: total(angular_velocity[:, :2] ** 2),
    "tilt_l2": lambda gravity: total(gravity[:, :2] ** 2),
    "upright": lambda gravity, tilt_variance: np.exp(-total(gravity[:, :2] ** 2) / tilt_variance),
    "base_height_l2": lambda base_height, target_height: (base_height - target_height) ** 2,
    "alive": lambda: np.ones(N),
    "fell_over": lambda gravity, fall_angle: gravity[:, 2] > -np.cos(fall_angle),
    "too_low": lambda base_height, least_height: base_height < least_height,
    # the command
    "command_size": size,
    "active": lambda command, least_command: size(command) > least_command,
    "heading_yaw_rate": lambda target_heading, heading, heading_gain, fastest_yaw_rate: np.clip(
        heading_gain * ((target_heading - heading + np.pi) % (2 * np.pi) - np.pi), -fastest_yaw_rate, fastest_yaw_rate
    ),
    # joints
    "posture": lambda qpos, joint_qpos, default_pose, pose_std: posture(qpos, joint_qpos, default_pose, pose_std),
    "pose": lambda command, qpos, joint_qpos, default_pose, standing_pose_std, walking_pose_std, least_command: posture(
        qpos, joint_qpos, default_pose,
        np.where(size(command)[:, None] < least_command, standing_pose_std, walking_pose_std),
    ),
    "pose_l2": lambda qpos, joint_qpos, default_pose: total((qpos[:, joint_qpos] - default_pose) ** 2),
    "joint_limits": limits,
    "sum_squares_at": lambda row, indices: total(row[:, indices] ** 2),
    "joint_velocity_l2": lambda qvel, joint_dof: total(qvel[:, joint_dof] ** 2),
    "joint_acceleration_l2": lambda qacc, joint_dof: total(qacc[:, joint_dof] ** 2),
    "torque_l2": lambda qfrc_actuator, joint_dof: total(qfrc_actuator[:, joint_dof] ** 2),
    "power": lambda qfrc_actuator, qvel, joint_dof: total(np.maximum((qfrc_actuator * qvel)[:, joint_dof], 0.0)),
    "absolute_power": lambda qfrc_actuator, qvel, joint_dof: total(np.abs((qfrc_actuator * qvel)[:, joint_dof])),
    # actions
    "action_rate_l2": lambda action, previous_action: total((action - previous_action) ** 2),
    "action_acceleration_l2": lambda action, previous_action, earlier_action: total(
        ((action - previous_action) - (previous_action - earlier_action)) ** 2
    ),
    # feet
    "sensor_vector": lambda sensordata, at: sensordata[:, at : at + 3],
    "ground_speed": lambda velocity: np.hypot(velocity[:, 0], velocity[:, 1]),
    "landed": lambda contact_seconds, dt: np.isin(np.round(contact_seconds / SUBSTEP), (1, 2, 3, 4)),
    "clearance": lambda foot_height, foot_velocity, swing_target: np.abs(foot_height - swing_target)
    * np.linalg.norm(foot_velocity[:, :2], axis=1),
    "foot_clearance": lambda site_xpos, feet, sensordata, foot_velocities, swing_target, active: active
    * total(np.abs(site_xpos[:, feet, 2] - swing_target) * speeds(sensordata, foot_velocities)),
    "foot_slip": lambda sensordata, foot_velocities, contact_time, active: active
    * total((contact_time > 0) * speeds(sensordata, foot_velocities) ** 2),
    "foot_swing_height": lambda contact_time, swing_height, swing_target, dt, active: active
    * total((contact_time > 0) * (np.round(contact_time / SUBSTEP) <= 4) * (swing_height / swing_target - 1) ** 2),
    "soft_landing": soft,
    # motors
    "servo_torque": lambda joint_target, joint_position, joint_velocity, kp, kd: kp * (joint_target - joint_position)
    - kd * joint_velocity,
    "dc_motor_torque": motor,
}  # fmt: skip


@pytest.mark.parametrize("name", FORMULAS)
def test_term_equals_its_formula(name: str) -> None:
    values = {argument: VALUES[argument] for argument in inspect.signature(FORMULAS[name]).parameters}
    as_arrays = {argument: np.array(value) if isinstance(value, list) else value for argument, value in values.items()}
    wanted = FORMULAS[name](**as_arrays)
    assert name == "alive" or len(np.unique(wanted)) > 1
    np.testing.assert_allclose(call(name, **values).result, wanted, rtol=2e-5, atol=2e-6)
