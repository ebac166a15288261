"""Plan with MPPI in Python, with single Gymnasium environments in subprocesses.

Each subprocess has an environment and gets one message per plan. NumPy computes noise and weights. ``PythonMPPI`` takes
its settings from an ``lw.MPPI`` and controls the same plant.
"""

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch

import lyceum_warp as lw

STATE = mujoco.mjtState.mjSTATE_INTEGRATION.value


class ReachEnv:
    """The task reach, written for Gymnasium with MuJoCo's objects and NumPy."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.finger, self.size = model.site("finger").id, mujoco.mj_stateSize(model, STATE)

    def set_state(self, state: np.ndarray) -> None:
        mujoco.mj_setState(self.model, self.data, state[: self.size], STATE)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        data = self.data
        data.ctrl[:] = np.clip(action, -1.0, 1.0)
        mujoco.mj_step(self.model, data, 2)
        mujoco.mj_kinematics(self.model, data)
        hand = data.site_xpos[self.finger]
        error = hand - data.mocap_pos[0]
        obs = np.concatenate([data.qpos, data.qvel, hand, error])
        return obs, float(-np.abs(error).sum() - 5.0 * np.sqrt(error @ error)), False, False, {}


class GymnasiumEnv:
    """An environment of Gymnasium or Gymnasium-Robotics that can be set to a state of this package's task.

    ``target`` is a mocap body of ``model``. In Gymnasium's model, the target is a body with a constant orientation.
    """

    def __init__(self, name: str, model: mujoco.MjModel, target: str | None = None) -> None:
        if name.startswith("Adroit"):
            import gymnasium_robotics

            gymnasium.register_envs(gymnasium_robotics)
        self.env: Any = gymnasium.make(name).unwrapped
        self.env.reset(seed=0)
        self.model, self.ours, self.size = model, mujoco.MjData(model), mujoco.mj_stateSize(model, STATE)
        self.target = None
        if target is not None:
            self.target = self.env.model.body(target).id, model.body(target).mocapid[0]

    def set_state(self, state: np.ndarray) -> None:
        data, ours = self.env.data, self.ours
        mujoco.mj_setState(self.model, ours, state[: self.size], STATE)
        data.time = ours.time
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = ours.qpos, ours.qvel, ours.qacc_warmstart
        if self.target is not None:
            there, here = self.target
            self.env.model.body_quat[there] = ours.mocap_quat[here]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return self.env.step(action)


ENVS: dict[str, Callable[[mujoco.MjModel], Any]] = {
    "reach": ReachEnv,
    "half_cheetah": lambda model: GymnasiumEnv("HalfCheetah-v5", model),
    "adroit_pen": lambda model: GymnasiumEnv("AdroitHandPen-v1", model, "target"),
}
"""Environment of each task. Actions lie between -1 and 1."""


def smoothed(noise: np.ndarray, smoothing: tuple[float, float, float]) -> np.ndarray:
    """Smooth the noise, (samples, horizon, nact), over time. Change it in place, but keep the first two steps."""
    for t in range(2, noise.shape[1]):
        noise[:, t] = smoothing[0] * noise[:, t] + smoothing[1] * noise[:, t - 1] + smoothing[2] * noise[:, t - 2]
    return noise


class PythonMPPI:
    """MPPI over single environments in ``count`` subprocesses, with the settings of ``plan``."""

    def __init__(self, task: str, plan: lw.MPPI, count: int) -> None:
        config = plan.config
        self.temperature, self.plan = config.temperature, np.zeros(tuple(plan.actions.shape))
        context = multiprocessing.get_context("spawn")
        self.pipes = []
        count = min(count, config.samples)
        for i, share in enumerate(np.diff(np.linspace(0, config.samples, count + 1).astype(int))):
            pipe, other = context.Pipe()
            settings = (task, int(share), config.horizon, config.noise, config.smoothing, i)
            context.Process(target=_roll_out, args=(other, *settings), daemon=True).start()
            other.close()  # close the child's end here, so that recv raises EOFError after the subprocess has ended
            self.pipes.append(pipe)
        for pipe in self.pipes:
            pipe.recv()

    def reset(self, seed: int | None) -> None:
        self.plan[:] = 0.0
        for pipe in self.pipes:
            pipe.send(seed)

    def __call__(self, state: torch.Tensor, obs: torch.Tensor | None = None) -> torch.Tensor:
        """Improve the plan from a state, return its first action, and shift the plan by one step."""
        for pipe in self.pipes:
            pipe.send((state.numpy(), self.plan))
        answers = [pipe.recv() for pipe in self.pipes]
        returns, actions = (np.concatenate(parts) for parts in zip(*answers, strict=True))
        weights = np.exp((returns - returns.max()) / self.temperature)
        plan = np.tensordot(weights / weights.sum(), actions, axes=1)
        self.plan = np.concatenate([plan[1:], np.zeros((1, plan.shape[1]))])
        return torch.from_numpy(plan[0].astype(np.float32))


def _roll_out(
    pipe: Connection,
    task: str,
    samples: int,
    horizon: int,
    scale: Any,
    smoothing: tuple[float, float, float],
    process: int,
) -> None:
    """Receive plans in a subprocess, roll out samples of each plan, and send their returns and actions."""
    env = ENVS[task](lw.make(task, nthread=1).model)
    random = np.random.default_rng((process, 0))
    pipe.send("ready")
    while True:
        message = pipe.recv()
        if isinstance(message, int):
            random = np.random.default_rng((process, message))
            continue
        state, plan = message
        noise = smoothed(scale * random.standard_normal((samples, horizon, plan.shape[1])), smoothing)
        if process == 0:
            noise[0] = 0.0  # the plan itself is one of the samples
        actions = np.clip(plan + noise, -1.0, 1.0)
        returns = np.zeros(samples)
        for k in range(samples):
            env.set_state(state)
            for t in range(horizon):
                returns[k] += env.step(actions[k, t])[1]
        pipe.send((returns, actions))
