"""Read states of go1_velocity, and compute the poses of its feet with MuJoCo."""

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
    """Read the states of all worlds, and compute heights and contacts of the feet with MuJoCo."""

    def __init__(self, env: lw.Env) -> None:
        parts = env.state_space.split(env.get_state())
        self.parts = {name: part.numpy().copy() for name, part in parts.items()}
        self.qpos, self.qvel = self.parts["qpos"], self.parts["qvel"]
        self.drawn, self.peak, self.last_action, self.contact_time, self.air_time = (
            self.parts[name] for name in ("drawn_velocity", "peak_height", "last_action", "contact_time", "air_time")
        )
        self.heading_target, self.command_timer, self.push_timer = (
            self.parts[name][:, 0] for name in ("heading_target", "command_timer", "push_timer")
        )
        self.heading_controlled, self.standing = (
            self.parts[name][:, 0] > 0 for name in ("heading_controlled", "standing")
        )
        self._kinematics()

    def _kinematics(self) -> None:
        model = mujoco.MjModel.from_xml_path(GO1)
        data, n = mujoco.MjData(model), len(self.qpos)
        self.height, self.touching = np.zeros((n, 4)), np.zeros((n, 4), bool)
        for i in range(n):
            data.qpos, data.qvel = self.qpos[i], self.qvel[i]
            mujoco.mj_forward(model, data)
            pairs = {frozenset(pair) for pair in data.contact.geom.tolist()}
            for k, leg in enumerate(LEGS):
                self.height[i, k] = max(data.site(f"{leg}_foot").xpos[2], 0.0)
                self.touching[i, k] = frozenset((model.geom("floor").id, model.geom(f"{leg}_foot").id)) in pairs


def random_steps(env: lw.Env, steps: int, size: float = 1.0) -> list[torch.Tensor]:
    """Return random actions that are correlated over time. Each has the shape (nworld, 12)."""
    generator, found = torch.Generator().manual_seed(1), [torch.zeros(env.nworld, 12)]
    for _ in range(steps):
        found.append(0.8 * found[-1] + 0.6 * size * torch.randn(env.nworld, 12, generator=generator))
    return found[1:]
