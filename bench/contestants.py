"""What samples in the experiments throughput and scaling: this package, MuJoCo's own rollout, and other libraries.

A sample is one environment step, with its observation and its reward in the hands of the caller. All use the same
model, substeps, bounds of uniformly random actions, and resets: after a number of steps from random initial states the
worlds are at random places of their episodes, and those that end restart. Each contestant gets as many worlds for each
thread as suit it.
"""

import contextlib
import importlib.util
import sys
from collections.abc import Iterator
from typing import Any

import experiment
import mujoco
import numpy as np
import peers
import torch
import warp as wp
from mujoco.rollout import Rollout

import lyceum_warp as lw

WORKER = "environments/sampling.py"
sys.path.append(str((peers.FOLDER / WORKER).parent))
import sampling  # noqa: E402  # a worker of the peers, whose clock and actions we share

LABELS = {
    "c": "ours, C engine",
    "warp": "ours, Warp engine",
    "native": "native C",
    "envpool": "EnvPool",
    "gym-async": "Gymnasium, AsyncVectorEnv",
    "gym-sync": "Gymnasium, SyncVectorEnv",
    "gymnasium": "Gymnasium",
    "gymnasium-newton": "Gymnasium, Newton's solver",
    "dm_control": "dm_control",
}

WORLDS = {"c": 64, "warp": 64, "native": 64, "envpool": 64, "gym-async": 2, "gym-sync": 16, "dm_control": 8}
"""Worlds for each thread; SyncVectorEnv has one thread."""

GPU_WORLDS = 16_384


def worlds(contestant: str, threads: int, device: str) -> int:
    """How many worlds a contestant steps at a time."""
    if contestant == "warp" and device.startswith("cuda"):
        return GPU_WORLDS
    return WORLDS[contestant] * (1 if contestant == "gym-sync" else threads)


def takes_part(contestant: str, task: str) -> bool:
    """Whether a contestant has a task; Newton's solver is another one than the model's own for humanoid alone."""
    if contestant == "gymnasium-newton":
        return task == "humanoid"
    return contestant != "envpool" or task in sampling.ENVPOOL


def measure(
    contestant: str, task: str, *, worlds: int, threads: int, device: str, seed: int, seconds: float, warm: int
) -> dict[str, Any]:
    """Environment steps per second.

    Args:
        contestant: A name of ``LABELS``.
        task: A task of this package.
        worlds: Number of worlds.
        threads: Number of threads, and of cores that they may use.
        device: Device of the Warp engine.
        seed: Seed of actions and initial states.
        seconds: How long to step.
        warm: Steps before that.

    Raises:
        experiment.Skipped: The contestant is not installed, or there are too few cores.
    """
    with experiment.cores(threads), torch_threads(1):
        if contestant in ("c", "warp"):
            made: Ours | Native = Ours(contestant, task, worlds, threads, device, seed)
        elif contestant == "native":
            made = Native(task, worlds, threads, seed, warm)
        else:
            settings = {"contestant": contestant, "task": task, "envs": worlds, "threads": threads}
            return worker(contestant).run(**settings, seed=seed, seconds=seconds, warm=warm)
        steps, passed = sampling.timed(made.step, len(made.actions), warm, seconds, made.wait)
    return {"env_steps_per_second": steps * worlds / passed, "steps": steps}


def worker(contestant: str) -> peers.Peer:
    """The program that measures another library."""
    if contestant in ("gymnasium", "gymnasium-newton", "gym-sync", "gym-async"):
        return peers.peer_here("gymnasium", WORKER)
    if contestant == "envpool" and importlib.util.find_spec("envpool"):
        return peers.peer_here("envpool", WORKER)
    return peers.peer(contestant, WORKER)


@contextlib.contextmanager
def torch_threads(number: int) -> Iterator[None]:
    """Keep torch's own threads from the cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(number)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Ours:
    """An environment of this package."""

    def __init__(self, contestant: str, task: str, nworld: int, threads: int, device: str, seed: int) -> None:
        engine = {"engine": "mujoco", "nthread": threads} if contestant == "c" else {"engine": "warp", "device": device}
        self.env = lw.make(task, nworld=nworld, seed=seed, **engine)
        self.actions = actions(self.env, seed)

    def step(self, t: int) -> None:
        self.env.action.copy_(self.actions[t])
        self.env.step()

    def wait(self) -> None:
        if not self.env.device.is_cpu:
            wp.synchronize_device(self.env.device)


def actions(env: lw.Env, seed: int) -> list[torch.Tensor]:
    """Actions of some steps, (nworld, nact) each; a list, because taking a tensor's rows would be timed, too."""
    low, high = (np.nan_to_num(x, posinf=1.0, neginf=-1.0) for x in (env.action_space.low, env.action_space.high))
    drawn = sampling.draw(np.asarray(low), np.asarray(high), env.nworld, seed)
    return list(torch.as_tensor(drawn, dtype=torch.float32, device=env.obs.device))


class Native:
    """``mujoco.rollout`` without a task: one call for every environment step, as the next actions are not known yet.

    It steps the states that our environment starts its steps from, after its warm-up, with the same controls. So it
    makes the same substeps and restarts, without observations and rewards.
    """

    def __init__(self, task: str, nworld: int, threads: int, seed: int, warm: int) -> None:
        ours = Ours("c", task, nworld, threads, "cpu", seed)
        env, engine = ours.env, ours.env.engine
        self.model, nstep = engine.native_model, env.task.frame_skip
        for t in range(warm):
            ours.step(t % len(ours.actions))
        self.actions = []
        for t in range(16):
            start = engine.batch.state.copy()
            ours.step(t)
            controls = env.field("ctrl").double().numpy()
            self.actions.append((*self._split(start), np.repeat(controls[:, None], nstep, axis=1)))
        size = self.actions[0][0].shape[1]
        self.out = np.zeros((nworld, nstep, size)), np.zeros((nworld, nstep, self.model.nsensordata))
        self.data = [mujoco.MjData(self.model) for _ in range(threads)]
        self.rollout = Rollout(nthread=threads)

    def _split(self, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The states that a rollout takes, and the accelerations that warm-start its solver."""
        data = mujoco.MjData(self.model)
        whole, full = mujoco.mjtState.mjSTATE_INTEGRATION.value, mujoco.mjtState.mjSTATE_FULLPHYSICS.value
        physics = np.zeros((len(states), mujoco.mj_stateSize(self.model, full)))
        warmstart = np.zeros((len(states), self.model.nv))
        for i, state in enumerate(states):
            mujoco.mj_setState(self.model, data, state, whole)
            mujoco.mj_getState(self.model, data, physics[i], full)
            warmstart[i] = data.qacc_warmstart
        return physics, warmstart

    def step(self, t: int) -> None:
        physics, warmstart, controls = self.actions[t]
        state, sensordata = self.out
        self.rollout.rollout(
            self.model, self.data, physics, controls, initial_warmstart=warmstart, state=state, sensordata=sensordata
        )

    def wait(self) -> None:
        """Each step has ended when its call returns."""
