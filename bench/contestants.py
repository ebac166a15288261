"""Step worlds with lyceum_warp, ``mujoco.rollout`` and other libraries, for the experiment "throughput".

A sample is one environment step whose observation and reward the caller has received. All contestants use the same
model, substeps and random actions. Each contestant uses the number of worlds per thread at which it is fastest.
"""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import experiment
import mujoco
import numpy as np
import torch
import venvs
import warp as wp
from mujoco.rollout import Rollout

import lyceum_warp as lw
from lyceum_warp.binding import find_task

WORKER = venvs.FOLDER / "environments" / "sampling.py"
sys.path.append(str(WORKER.parent))
import sampling  # noqa: E402  # a worker of the peers; its clock and its actions serve here, too

LABELS = {
    "c": "lyceum_warp, C engine",
    "warp": "lyceum_warp, Warp engine",
    "c-suggested": "C engine, suggested physics",
    "warp-suggested": "Warp engine, suggested physics",
    "native": "native C",
    "envpool": "EnvPool",
    "gym-async": "Gymnasium, AsyncVectorEnv",
    "gym-sync": "Gymnasium, SyncVectorEnv",
    "gymnasium": "Gymnasium",
    "dm_control": "dm_control",
}

WORLDS = {"c": 64, "warp": 64, "native": 64, "envpool": 64, "gym-async": 2, "gym-sync": 16, "dm_control": 8}
"""Default number of worlds per thread."""

GPU_WORLDS = 16_384


def worlds(contestant: str, threads: int, device: str) -> int:
    if contestant == "warp" and device.startswith("cuda"):
        return GPU_WORLDS
    return WORLDS[contestant.removesuffix("-suggested")] * (1 if contestant == "gym-sync" else threads)


def takes_part(contestant: str, task: str) -> bool:
    if contestant == "envpool":
        return task in sampling.ENVPOOL
    return task in sampling.GYMNASIUM or not contestant.startswith("gym")


def measure(
    contestant: str, task: str, *, worlds: int, threads: int, device: str, seed: int, seconds: float, warm: int
) -> dict[str, Any]:
    """Measure environment steps per second of a contestant in ``LABELS``."""
    torch.set_num_threads(1)
    with experiment.cores(threads):
        if contestant.startswith(("c", "warp")):
            stepper: LyceumWarp | Native = LyceumWarp(contestant, task, worlds, threads, device, seed)
        elif contestant == "native":
            stepper = Native(task, worlds, threads, seed, warm)
        else:
            settings = {"contestant": contestant, "task": task, "envs": worlds, "threads": threads}
            return venvs.run(python_of(contestant), WORKER, **settings, seed=seed, seconds=seconds, warm=warm)
        steps, passed = sampling.timed(stepper.step, len(stepper.actions), warm, seconds, stepper.wait)
    return {"env_steps_per_second": steps * worlds / passed, "steps": steps}


def python_of(contestant: str) -> Path:
    if contestant.startswith("gym") or (contestant == "envpool" and importlib.util.find_spec("envpool")):
        return Path(sys.executable)
    return venvs.python_of(contestant)


class LyceumWarp:
    def __init__(self, contestant: str, task: str, nworld: int, threads: int, device: str, seed: int) -> None:
        options: dict[str, Any] = {"engine": "warp", "device": device}
        if contestant.startswith("c"):
            options = {"engine": "mujoco", "nthread": threads}
        if contestant.endswith("suggested"):
            options["physics"] = find_task(task).training.physics
        self.env = lw.make(task, nworld=nworld, seed=seed, **options)
        self.actions = actions(self.env, seed)

    def step(self, t: int) -> None:
        self.env.action.copy_(self.actions[t])
        self.env.step()

    def wait(self) -> None:
        if not self.env.device.is_cpu:
            wp.synchronize_device(self.env.device)


def actions(env: lw.Env, seed: int) -> list[torch.Tensor]:
    """Return a list with the actions of each step; indexing a tensor would take time."""
    low = np.nan_to_num(env.action_space.low, neginf=-1.0)
    high = np.nan_to_num(env.action_space.high, posinf=1.0)
    draws = sampling.draw(np.asarray(low), np.asarray(high), env.nworld, seed)
    return list(torch.as_tensor(draws, dtype=torch.float32, device=env.obs.device))


class Native:
    """``mujoco.rollout`` without observations and rewards. It starts from the states of lyceum_warp's environment."""

    def __init__(self, task: str, nworld: int, threads: int, seed: int, warm: int) -> None:
        ours = LyceumWarp("c", task, nworld, threads, "cpu", seed)
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
        """Return the states of a rollout, and the accelerations that warm-start its solver."""
        data = mujoco.MjData(self.model)
        integration, full_physics = mujoco.mjtState.mjSTATE_INTEGRATION.value, mujoco.mjtState.mjSTATE_FULLPHYSICS.value
        physics = np.zeros((len(states), mujoco.mj_stateSize(self.model, full_physics)))
        warmstart = np.zeros((len(states), self.model.nv))
        for i, state in enumerate(states):
            mujoco.mj_setState(self.model, data, state, integration)
            mujoco.mj_getState(self.model, data, physics[i], full_physics)
            warmstart[i] = data.qacc_warmstart
        return physics, warmstart

    def step(self, t: int) -> None:
        physics, warmstart, controls = self.actions[t]
        state, sensordata = self.out
        self.rollout.rollout(
            self.model, self.data, physics, controls, initial_warmstart=warmstart, state=state, sensordata=sensordata
        )

    def wait(self) -> None:
        """Do nothing, because steps are synchronous."""
