"""Compute the formulas of go1_velocity in NumPy from MuJoCo's own kinematics."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch

import lyceum_warp as lw
from lyceum_warp.tasks.velocity import go1

GO1 = str(Path(go1.__file__).with_name("go1.xml"))
DT, SUBSTEP = 0.02, 0.005
LEGS = ("FR", "FL", "RR", "RL")
HOME = np.array([0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2)
NEVER = (1e6, 1e6)
NOISELESS = {
    f"{part}_noise": 0.0
    for part in ("linear_velocity", "angular_velocity", "gravity", "joint_position", "joint_velocity")
}
STILL: dict[str, Any] = {**NOISELESS, "command_seconds": NEVER, "push_seconds": NEVER}
"""Parameters that disable noise and events."""


class State:
    """The parts of all worlds' states in float64, and MuJoCo's kinematics of these states."""

    def __init__(self, env: lw.Env, state: torch.Tensor | None = None) -> None:
        parts = env.state_space.split(env.get_state() if state is None else state)
        self.parts = {name: part.numpy().copy() for name, part in parts.items()}
        self.qpos, self.qvel = self.parts["qpos"], self.parts["qvel"]
        self.force = self.parts["sensordata"].reshape(-1, 4, 3)
        self.drawn, self.bias, self.peak = (
            self.parts[name] for name in ("drawn_velocity", "encoder_bias", "peak_height")
        )
        self.heading_target, self.command_timer, self.push_timer, self.env_steps = (
            self.parts[name][:, 0] for name in ("heading_target", "command_timer", "push_timer", "env_steps")
        )
        self.heading_controlled, self.standing = (
            self.parts[name][:, 0] > 0 for name in ("heading_controlled", "standing")
        )
        self.last_action, self.contact_time, self.air_time = (
            self.parts[name] for name in ("last_action", "contact_time", "air_time")
        )
        self._kinematics(env.model)

    def _kinematics(self, own: mujoco.MjModel) -> None:
        spec = mujoco.MjSpec.from_file(GO1)
        for kind, name in ((mujoco.mjtSensor.mjSENS_VELOCIMETER, "v"), (mujoco.mjtSensor.mjSENS_GYRO, "w")):
            spec.add_sensor(type=kind, name=name, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu")
        model = spec.compile()
        data, n = mujoco.MjData(model), len(self.qpos)
        self.imu_velocity, self.gyro = np.zeros((n, 3)), np.zeros((n, 3))
        self.v, self.w, self.gravity = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
        self.heading, self.foot, self.foot_velocity = np.zeros(n), np.zeros((n, 4, 3)), np.zeros((n, 4, 3))
        self.touching, motion = np.zeros((n, 4), bool), np.zeros(6)
        for i in range(n):
            data.qpos, data.qvel = self.qpos[i], self.qvel[i]
            mujoco.mj_forward(model, data)
            trunk, kind = data.body("trunk"), mujoco.mjtObj
            axes = trunk.xmat.reshape(3, 3)
            mujoco.mj_objectVelocity(model, data, kind.mjOBJ_XBODY, trunk.id, motion, 1)
            self.w[i], self.v[i] = motion[:3], motion[3:]
            self.gravity[i] = axes.T @ [0, 0, -1]
            self.heading[i] = np.arctan2(axes[1, 0], axes[0, 0])
            self.imu_velocity[i], self.gyro[i] = data.sensor("v").data, data.sensor("w").data
            for k, leg in enumerate(LEGS):
                site, geom = data.site(f"{leg}_foot"), data.geom(f"{leg}_foot").id
                mujoco.mj_objectVelocity(model, data, kind.mjOBJ_SITE, site.id, motion, 0)
                self.foot[i, k], self.foot_velocity[i, k] = site.xpos, motion[3:]
                pairs = {frozenset(pair) for pair in data.contact.geom.tolist()}
                self.touching[i, k] = frozenset((model.geom("floor").id, geom)) in pairs

    @property
    def height(self) -> np.ndarray:
        return np.maximum(self.foot[..., 2], 0.0)

    @property
    def foot_speed(self) -> np.ndarray:
        return np.linalg.norm(self.foot_velocity[..., :2], axis=-1)

    def command(self, fastest: float = 0.5) -> np.ndarray:
        command = self.drawn.copy()
        error = (self.heading_target - self.heading + np.pi) % (2 * np.pi) - np.pi
        command[self.heading_controlled, 2] = np.clip(0.5 * error, -fastest, fastest)[self.heading_controlled]
        command[self.standing] = 0.0
        return command


def expected_terms(s0: State, action: np.ndarray, s1: State, model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return the weighted reward terms per second, each (nworld,)."""
    c = s0.command()
    amount = np.linalg.norm(c[:, :2], axis=1) + np.abs(c[:, 2])
    active, std = amount > 0.05, np.where(amount[:, None] < 0.05, [0.05, 0.05, 0.1], [0.3, 0.3, 0.6])
    low, high = model.jnt_range[1:].T
    middle, half = (low + high) / 2, 0.9 * (high - low) / 2
    q = s1.qpos[:, 7:]
    landed = (s1.contact_time > 0) & (s1.contact_time < DT + 1e-6)
    loaded = (s1.contact_time > SUBSTEP + 1e-6) & (s1.contact_time < DT + SUBSTEP + 1e-6)
    linear = np.square(c[:, :2] - s1.v[:, :2]).sum(axis=1) + s1.v[:, 2] ** 2
    angular = (c[:, 2] - s1.w[:, 2]) ** 2 + np.square(s1.w[:, :2]).sum(axis=1)
    return {
        "track_linear_velocity": 2.0 * np.exp(-linear / 0.25),
        "track_angular_velocity": 2.0 * np.exp(-angular / 0.5),
        "upright": np.exp(-np.square(s1.gravity[:, :2]).sum(axis=1) / 0.2),
        "pose": np.exp(-np.square((q - HOME) / np.tile(std, 4)).mean(axis=1)),
        "dof_pos_limits": -np.maximum(np.abs(q - middle) - half, 0.0).sum(axis=1),
        "action_rate_l2": -0.1 * np.square(action - s0.last_action).sum(axis=1),
        "foot_clearance": -2.0 * active * (np.abs(s1.height - 0.1) * s1.foot_speed).sum(axis=1),
        "foot_swing_height": -0.25 * active * (landed * (s0.peak / 0.1 - 1.0) ** 2).sum(axis=1),
        "foot_slip": -0.1 * active * (s1.touching * s1.foot_speed**2).sum(axis=1),
        "soft_landing": -1e-5 * active * (loaded * np.linalg.norm(s1.force, axis=2)).sum(axis=1),
    }


def random_steps(env: lw.Env, steps: int, size: float = 1.0) -> list[torch.Tensor]:
    """Return actions that are correlated over time, each (nworld, 12)."""
    generator, found = torch.Generator().manual_seed(1), [torch.zeros(env.nworld, 12)]
    for _ in range(steps):
        found.append(0.8 * found[-1] + 0.6 * size * torch.randn(env.nworld, 12, generator=generator))
    return found[1:]
