"""Compute joint positions of a scripted lift, and move a robot's servos to them."""

from collections.abc import Sequence

import mujoco
import numpy as np
import torch

import lyceum_warp as lw


def joints_at(
    model: mujoco.MjModel, qpos: np.ndarray, site: str, place: np.ndarray, axes: np.ndarray, joints: Sequence[str]
) -> np.ndarray:
    """Find joint positions (nq,) at which a site has the given position and axes."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    dofs = [int(model.joint(name).dofadr[0]) for name in joints]
    addresses = [int(model.joint(name).qposadr[0]) for name in joints]
    ranges = np.array([model.joint(name).range for name in joints])
    index = model.site(site).id
    jacobian = np.zeros((6, model.nv))
    for _ in range(200):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], index)
        now = data.site_xmat[index].reshape(3, 3)
        turn = 0.5 * np.cross(now, axes, axis=0).sum(axis=1)
        error = np.concatenate([place - data.site_xpos[index], 0.3 * turn])
        j = jacobian[:, dofs] * np.repeat([1.0, 0.3], 3)[:, None]
        step = j.T @ np.linalg.solve(j @ j.T + 1e-4 * np.eye(6), error)
        data.qpos[addresses] = np.clip(data.qpos[addresses] + step, ranges[:, 0], ranges[:, 1])
    assert np.linalg.norm(place - data.site_xpos[index]) < 2e-3, f"{site} can't reach {place}"
    return data.qpos.copy()


def follow(env: lw.Env, targets: np.ndarray, steps: int) -> None:
    speed = torch.tensor(env.model.actuator_ctrlrange[:, 1])
    for _ in range(steps):
        act = env.state_space.split(env.get_state())["act"]
        velocity = (torch.from_numpy(targets) - act) / (speed * env.timestep)
        env.step(velocity.clamp(-1.0, 1.0).float())
