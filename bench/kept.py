"""Compare the step time of an environment with the step time of its physics engine alone, on the same states.

The environment takes ten steps, and then the same steps again, each after a step of the bare engine (the engine without
a task) from the same state, with the same controls and model fields. The bare engine is ``mujoco.batch.Batch.step`` or
one graph of ``mujoco_warp.step``. ``kept`` is the bare engine's step time divided by the environment's step time, and
``added`` is their difference.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any

import contestants
import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from mujoco.batch import Batch

import lyceum_warp as lw
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.engines.c.world_models import WorldModels
from lyceum_warp.engines.warp.warp_engine import WarpEngine
from lyceum_warp.support.arrays import flat, torch_view

BLOCK = 10
"""Steps per turn."""


def next_controls(env: lw.Env) -> torch.Tensor:
    """Return the controls of the next step, which computes them again."""
    steps = torch_view(env.worlds.counters.step)
    before = steps.clone()
    env.worlds.act()
    steps.copy_(before)
    return torch_view(env.engine.ctrl).clone()


class BareC:
    """``mujoco.batch.Batch`` alone, on the states and model fields of an environment's C engine."""

    def __init__(self, env: lw.Env) -> None:
        self.env, engine = env, env.engine
        assert isinstance(engine, MujocoEngine)
        self.rows = engine.batch.state
        self.batch = Batch(engine.batch.model, env.nworld, engine.nthread)
        self.models = WorldModels(self.batch, engine.dynamics.values())
        self.values = {name: flat(engine.arrays[name]).numpy() for name in engine.dynamics}

    def load(self) -> None:
        self.models.apply(self.values)
        self.batch.state[:], self.batch.ctrl[:] = self.rows, next_controls(self.env).numpy()

    def step(self) -> None:
        self.batch.step(nstep=self.env.task.frame_skip)


class BareWarp:
    """A graph of ``mujoco_warp.step`` alone, on the states and model fields of an environment's Warp engine."""

    def __init__(self, env: lw.Env) -> None:
        self.env, engine = env, env.engine
        assert isinstance(engine, WarpEngine)
        self.engine = engine
        self.spec = mujoco.mjtState.mjSTATE_INTEGRATION.value
        with wp.ScopedDevice(env.device):
            self.m, self.d = engine.bare()
            mjw.step(self.m, self.d)
            with wp.ScopedCapture() as capture:
                for _ in range(env.task.frame_skip):
                    mjw.step(self.m, self.d)
        self.graph = capture.graph

    def load(self) -> None:
        with wp.ScopedDevice(self.env.device):
            state = wp.zeros((self.env.nworld, self.engine.integration_size), dtype=float)
            mjw.get_state(self.engine.m, self.engine.d, state, self.spec)
            mjw.set_state(self.m, self.d, state, self.spec)
        wp.to_torch(self.d.ctrl).copy_(next_controls(self.env))

    def step(self) -> None:
        wp.capture_launch(self.graph)


def bare_engine(env: lw.Env) -> BareC | BareWarp:
    return BareC(env) if isinstance(env.engine, MujocoEngine) else BareWarp(env)


def seconds(env: lw.Env, function: Callable[[], object]) -> float:
    """Return the seconds of a function; on a GPU, those between two events, without the wait for earlier launches."""
    if env.device.is_cpu:
        begin = time.perf_counter()
        function()
        return time.perf_counter() - begin
    with wp.ScopedDevice(env.device):
        start, end = (wp.Event(enable_timing=True) for _ in range(2))
        wp.record_event(start)
        function()
        wp.record_event(end)
    return 1e-3 * wp.get_event_elapsed_time(start, end)


def seconds_of_bare(env: lw.Env, bare: BareC | BareWarp, actions: list[torch.Tensor]) -> float:
    """Return the seconds of the bare engine's steps; the environment takes each step after the bare engine."""
    total = 0.0
    for t in range(BLOCK):
        env.action.copy_(actions[t])
        bare.load()
        bare.step()  # only fills the caches, as the environment's last step does, and lets the next launch wait in line
        bare.load()
        total += seconds(env, bare.step)
        env.step()
    return total


def measure(task: str, nworld: int, blocks: int, policy: str | None = None, **place: Any) -> dict[str, Any]:
    """Return the median step times of an environment and of its bare engine."""
    env = lw.make(task, nworld=nworld, **place)
    actions = contestants.actions(env, seed=0)
    acting = None if policy is None else lw.load(policy, device=env.obs.device)
    bare = bare_engine(env)

    def choose_actions() -> None:
        if acting is not None:
            start = env.get_state()
            for t in range(BLOCK):
                actions[t].copy_(acting.act(env.obs))
                env.step(actions[t])
            env.set_state(start)

    def block() -> None:
        for t in range(BLOCK):
            env.action.copy_(actions[t])
            env.step()

    env_seconds, bare_seconds = [], []
    # the first blocks are not counted: they capture graphs, and a robot takes two seconds to start walking
    warm = max(2 if policy is None else 20, env.horizon // 500)
    for repetition in range(warm + blocks):
        choose_actions()
        start = env.get_state()
        time_env = seconds(env, block)
        env.set_state(start)
        time_bare = seconds_of_bare(env, bare, actions)
        if repetition >= warm:
            env_seconds.append(time_env / BLOCK)
            bare_seconds.append(time_bare / BLOCK)
    return {
        "env_steps_per_second": env.nworld / statistics.median(env_seconds),
        "bare_steps_per_second": env.nworld / statistics.median(bare_seconds),
        "kept": statistics.median(b / a for a, b in zip(env_seconds, bare_seconds, strict=True)),
        "added_microseconds": 1e6 * statistics.median(a - b for a, b in zip(env_seconds, bare_seconds, strict=True)),
        "bytes_per_world": env.bytes_per_world,
    }
