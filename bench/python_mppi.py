"""MPPI in Python over single environments with Gymnasium's step, in processes: what the mppi experiment compares with.

``PythonMPPI`` is a careful planner without this package: an environment in each of the processes, which are kept
alive; one message for each plan and process; noise and weights in NumPy. ``StepwiseMPPI`` is the simple one: as
Gymnasium's asynchronous vector environment does, it sends a message for each step of each sample. Both have the
settings of an ``lw.MPPI`` and control the same plant.
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
    """Reach as one writes it for Gymnasium: MuJoCo's own objects, NumPy, and as little else as can be."""

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
    """An environment of Gymnasium or Gymnasium-Robotics, put into a state of our task.

    Args:
        name: Gymnasium's name.
        model: Our model, which describes the states.
        target: A body that is a part of the model there and a mocap body of ours: its orientation is in our state.
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
"""Environments by the names of our tasks; their actions are bounded by -1 and 1."""


class Processes:
    """Processes with an environment each, that wait until a function has made it.

    Args:
        count: Number of processes.
        target: What a process runs; it gets its end of a pipe first, and a last message that is None.
        arguments: Further arguments of each.
    """

    def __init__(self, count: int, target: Callable[..., None], arguments: list[tuple[Any, ...]]) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipes, self.processes = [], []
        for i in range(count):
            pipe, other = context.Pipe()
            process = context.Process(target=target, args=(other, *arguments[i]), daemon=True)
            process.start()
            other.close()  # so that the end of the process ends our waiting for it
            self.pipes.append(pipe)
            self.processes.append(process)
        for pipe in self.pipes:
            pipe.recv()

    def close(self) -> None:
        for pipe in self.pipes:
            pipe.send(None)
        for process in self.processes:
            process.join()


def smoothed(noise: np.ndarray, smoothing: tuple[float, float, float]) -> np.ndarray:
    """Noise smoothed over time from the third step on, in place; (samples, horizon, nact)."""
    for t in range(2, noise.shape[1]):
        noise[:, t] = smoothing[0] * noise[:, t] + smoothing[1] * noise[:, t - 1] + smoothing[2] * noise[:, t - 2]
    return noise


class _Controller:
    """What both planners have in common: settings, plan and update."""

    def __init__(self, plan: lw.MPPI, count: int) -> None:
        config, self.shape = plan.config, tuple(plan.actions.shape)
        self.samples, self.horizon, self.temperature = config.samples, config.horizon, config.temperature
        self.noise, self.smoothing = config.noise, config.smoothing
        self.count = min(count, config.samples)
        self.shares = np.diff(np.linspace(0, config.samples, self.count + 1).astype(int))
        self.plan = np.zeros(self.shape)
        self.processes: Processes

    def reset(self, seed: int | None) -> None:
        """Forget the plan."""
        self.plan[:] = 0.0

    def __call__(self, state: torch.Tensor, obs: torch.Tensor | None = None) -> torch.Tensor:
        """Improve the plan from a state; returns its first action, and moves the plan forward by a step."""
        returns, actions = self.rollout(state.numpy())
        weights = np.exp((returns - returns.max()) / self.temperature)
        plan = np.tensordot(weights / weights.sum(), actions, axes=1)
        self.plan = np.concatenate([plan[1:], np.zeros((1, plan.shape[1]))])
        return torch.from_numpy(plan[0].astype(np.float32))

    def rollout(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns, (samples,), and actions, (samples, horizon, nact), of noisy samples of the plan."""
        raise NotImplementedError

    def close(self) -> None:
        self.processes.close()


class PythonMPPI(_Controller):
    """MPPI over single environments in processes, one message for each plan and process."""

    def __init__(self, task: str, plan: lw.MPPI, count: int) -> None:
        super().__init__(plan, count)
        settings = [(task, int(share), self.horizon, self.noise, self.smoothing, i)
                    for i, share in enumerate(self.shares)]  # fmt: skip
        self.processes = Processes(self.count, _roll_out, settings)

    def reset(self, seed: int | None) -> None:
        super().reset(seed)
        for pipe in self.processes.pipes:
            pipe.send(seed)

    def rollout(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        for pipe in self.processes.pipes:
            pipe.send((state, self.plan))
        answers = [pipe.recv() for pipe in self.processes.pipes]
        returns, actions = (np.concatenate(parts) for parts in zip(*answers, strict=True))
        return returns, actions


def _roll_out(
    pipe: Connection, task: str, samples: int, horizon: int, scale: Any, smoothing: tuple[float, float, float], own: int
) -> None:
    """A process of ``PythonMPPI``: rolls out its share of the samples for every plan that it is sent."""
    env = ENVS[task](lw.make(task, nthread=1).model)
    random = np.random.default_rng((own, 0))
    pipe.send("ready")
    while (message := pipe.recv()) is not None:
        if isinstance(message, int):
            random = np.random.default_rng((own, message))
            continue
        state, plan = message
        noise = smoothed(scale * random.standard_normal((samples, horizon, plan.shape[1])), smoothing)
        if own == 0:
            noise[0] = 0.0  # the plan itself is a sample
        actions = np.clip(plan + noise, -1.0, 1.0)
        returns = np.zeros(samples)
        for k in range(samples):
            env.set_state(state)
            for t in range(horizon):
                returns[k] += env.step(actions[k, t])[1]
        pipe.send((returns, actions))


class StepwiseMPPI(_Controller):
    """MPPI over single environments in processes, one message for each step of each sample."""

    def __init__(self, task: str, plan: lw.MPPI, count: int) -> None:
        super().__init__(plan, count)
        self.processes = Processes(self.count, _step, [(task,)] * self.count)
        self.random = np.random.default_rng(0)

    def reset(self, seed: int | None) -> None:
        super().reset(seed)
        self.random = np.random.default_rng(seed)

    def rollout(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        noise = smoothed(self.noise * self.random.standard_normal((self.samples, *self.shape)), self.smoothing)
        noise[0] = 0.0  # the plan itself is a sample
        actions = np.clip(self.plan + noise, -1.0, 1.0)
        returns = np.zeros(self.samples)
        for first in range(0, self.samples, self.count):
            wave = list(enumerate(self.processes.pipes, start=first))[: self.samples - first]
            for _, pipe in wave:
                pipe.send(("state", state))
            for t in range(self.horizon):
                for k, pipe in wave:
                    pipe.send(("step", actions[k, t]))
                for k, pipe in wave:
                    _obs, reward, _terminated, _truncated, _info = pipe.recv()
                    returns[k] += reward
        return returns, actions


def _step(pipe: Connection, task: str) -> None:
    """A process of ``StepwiseMPPI``: sets its environment's state, or steps it, as each message says."""
    env = ENVS[task](lw.make(task, nthread=1).model)
    pipe.send("ready")
    while (message := pipe.recv()) is not None:
        kind, value = message
        if kind == "state":
            env.set_state(value)
        else:
            pipe.send(env.step(value))
