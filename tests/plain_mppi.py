"""MPPI by its definition, in NumPy and with one world's step at a time: what the planner must agree with."""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import torch

import lyceum_warp as lw


def smoothed(noise: np.ndarray, betas: tuple[float, ...]) -> np.ndarray:
    """Noise over time, (horizon, ...): the first two steps stay as they are, those after mix with the last two."""
    result = noise.copy()
    for t in range(2, len(noise)):
        result[t] = betas[0] * noise[t] + betas[1] * result[t - 1] + betas[2] * result[t - 2]
    return result


class Plain:
    """MPPI by its definition, in float64. It is given standard normal numbers, and does everything else itself."""

    def __init__(
        self,
        task: str,
        *,
        engine: str,
        horizon: int,
        samples: int,
        temperature: float,
        noise: Any,
        smoothing: tuple[float, ...] = (0.25, 0.8, 0.0),
        discount: float = 1.0,
        fill: Any = "zero",
        termination: str = "stop",
        value: Callable[[torch.Tensor], torch.Tensor] | None = None,
        **options: Any,
    ) -> None:
        self.env = lw.make(task, engine=engine, nworld=samples, autoreset=False, horizon=0, **options)
        self.low, self.high = self.env.action_space.low, self.env.action_space.high
        nu = len(self.low)
        array = np.asarray(noise, dtype=float)
        self.factor = np.linalg.cholesky(array) if array.ndim == 2 else np.diag(np.broadcast_to(array, nu))
        self.temperature, self.smoothing, self.discount = temperature, smoothing, discount
        self.stop, self.value, self.repeat = termination == "stop", value, isinstance(fill, str) and fill == "repeat"
        self.fill = np.zeros(nu) if isinstance(fill, str) else np.asarray(fill, dtype=float)
        self.actions = np.tile(np.clip(self.fill, self.low, self.high), (horizon, 1))

    def __call__(self, state: torch.Tensor, noises: list[np.ndarray], shift: int = 1) -> None:
        for _ in range(shift):
            last = self.actions[-1] if self.repeat else np.clip(self.fill, self.low, self.high)
            self.actions = np.vstack([self.actions[1:], last])
        for z in noises:
            self.improve(state, z)

    def improve(self, state: torch.Tensor, z: np.ndarray) -> None:
        noise = smoothed(np.einsum("ij,tkj->tki", self.factor, z), self.smoothing)
        self.sampled = np.clip(self.actions[:, None] + noise, self.low, self.high)
        rewards, ended, values = self.roll_out(state)
        self.returns = np.zeros(z.shape[1])
        for k in range(len(self.returns)):
            weight, going = 1.0, True
            for reward, end in zip(rewards[:, k], ended[:, k], strict=True):
                if going:
                    self.returns[k] += weight * reward
                    weight *= self.discount
                    going = not (self.stop and end)
            if going:
                self.returns[k] += weight * values[k]
        weights = np.exp((self.returns - self.returns.max()) / self.temperature)
        self.weights = weights / weights.sum()
        self.actions = np.einsum("k,tki->ti", self.weights, self.sampled)

    def roll_out(self, state: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rewards and ends of each step, and the values of the states after the last one."""
        env = self.env
        env.set_state(state.expand(env.nworld, -1).contiguous())
        rewards, ended = np.zeros((2, *self.sampled.shape[:2]))
        for t, actions in enumerate(self.sampled):
            env.step(torch.as_tensor(actions, dtype=torch.float32))
            rewards[t], ended[t] = env.reward.numpy(), env.terminated.numpy()
        self.ended = ended
        return rewards, ended, np.zeros(env.nworld) if self.value is None else self.value(env.obs).numpy()


class PlainReach(Plain):
    """The same with the physics and the reward of the reach task in MuJoCo and NumPy alone."""

    def roll_out(self, state: torch.Tensor) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        model = self.env.model
        data = mujoco.MjData(model)
        spec = mujoco.mjtState.mjSTATE_INTEGRATION.value
        rewards = np.zeros(self.sampled.shape[:2])
        for k in range(rewards.shape[1]):
            mujoco.mj_setState(model, data, state[: mujoco.mj_stateSize(model, spec)].numpy(), spec)
            for t in range(len(rewards)):
                data.ctrl[:] = self.sampled[t, k]
                for _ in range(2):
                    mujoco.mj_step(model, data)
                mujoco.mj_kinematics(model, data)
                error = data.site("finger").xpos - data.mocap_pos[0]
                rewards[t, k] = -np.abs(error).sum() - 5 * np.sqrt((error**2).sum())
        return rewards, np.zeros_like(rewards), np.zeros(rewards.shape[1])
