"""What a step costs beside the bare engine on the same states.

Environment and bare engine take turns of ten steps: each state that the environment starts a step from is copied to
the bare engine, outside the clock, so that both step the same states, resets included, under the same load of the
machine. The bare engine is ``mujoco.batch.Batch.step`` or one graph of ``mujoco_warp.step``, with the same model,
controls and number of substeps. ``kept`` is bare time by environment time; ``added`` is the difference. ``refresh`` is
the time for fields that ``mj_step`` leaves behind, as a share of the step. On the Warp engine it counts those of the
new state where the task reads positions, and a forward pass of the restarted worlds where it reads forces; what the
next step takes over is counted, too. On the C engine it counts those of the new state.

Beside the package's tasks there is ``quadruped``, dm_control's, which reads sensors; dm_control must be installed.
The experiment throughput prints these numbers.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import contestants
import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from mujoco.batch import Batch

import lyceum_warp as lw
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.engines.warp.warp_engine import WarpEngine
from lyceum_warp.support.arrays import launch_worlds

FILES = {"quadruped": Path(__file__).with_name("quadruped.py")}
"""Tasks of this folder."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is measured."""

    task: str
    nworld: int
    engine: str = "mujoco"
    device: str = "cpu"
    nthread: int = 0
    """Threads of the C engine; 0 for all cores."""
    blocks: int = 50
    """Blocks of ten steps; the results are medians over them."""
    apart: bool = False
    """Whether the worlds are at different steps of their episodes, so that some restart in every step."""
    npg: bool = False
    """Whether NPG samples: the policy's forward passes, the noise and the rollout buffer are part of the step."""
    policy: Path | None = None
    """A run, or the file of a policy, whose mean policy chose the actions; random actions by default."""


def next_controls(env: lw.Env) -> torch.Tensor:
    """The controls of the environment's next step, (nworld, nu)."""
    if (control := env.task.kernels.control_worlds) is None:
        low, high = (torch.as_tensor(x, device=env.obs.device) for x in (env.action_space.low, env.action_space.high))
        return env.action.clamp(low, high)
    controls = wp.zeros_like(env.engine.ctrl)
    args = [env.worlds.after, env.worlds.params, env.worlds.action, controls]
    launch_worlds(control, env.nworld, args, env.device)
    return wp.to_torch(controls)


class BareC:
    """``mujoco.batch.Batch`` alone, on the states of an environment's C engine."""

    def __init__(self, env: lw.Env) -> None:
        self.env, engine = env, env.engine
        assert isinstance(engine, MujocoEngine)
        self.rows = engine.batch.state
        self.batch = Batch(engine.batch.model, env.nworld, engine.nthread)

    def snapshot(self) -> tuple[np.ndarray, np.ndarray]:
        """States and controls of the environment's next step."""
        return self.rows.copy(), next_controls(self.env).numpy()

    def load(self, snapshot: tuple[np.ndarray, np.ndarray]) -> None:
        self.batch.state[:], self.batch.ctrl[:] = snapshot

    def step(self) -> None:
        self.batch.step(nstep=self.env.task.frame_skip)


class BareWarp:
    """A graph of ``mujoco_warp.step`` alone, on the states of an environment's Warp engine."""

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

    def snapshot(self) -> tuple[wp.array, torch.Tensor]:
        """States and controls of the environment's next step."""
        with wp.ScopedDevice(self.env.device):
            state = wp.zeros((self.env.nworld, self.engine.integration_size), dtype=float)
            mjw.get_state(self.engine.m, self.engine.d, state, self.spec)
        return state, next_controls(self.env)

    def load(self, snapshot: tuple[wp.array, torch.Tensor]) -> None:
        with wp.ScopedDevice(self.env.device):
            mjw.set_state(self.m, self.d, snapshot[0], self.spec)
        wp.to_torch(self.d.ctrl).copy_(snapshot[1])
        synchronize(self.env)

    def step(self) -> None:
        wp.capture_launch(self.graph)


def bare_engine(env: lw.Env) -> BareC | BareWarp:
    return BareC(env) if isinstance(env.engine, MujocoEngine) else BareWarp(env)


def synchronize(env: lw.Env) -> None:
    if not env.device.is_cpu:
        wp.synchronize_device(env.device)


def seconds(env: lw.Env, function: Callable[[], object]) -> float:
    start = time.perf_counter()
    function()
    synchronize(env)
    return time.perf_counter() - start


BLOCK = 10
"""Steps after which environment and bare engine change places."""

FOLLOWED = 250
"""Steps of a policy before anything is measured under its actions."""


def compare(
    env: lw.Env,
    blocks: int,
    act: Callable[[int], None],
    block: Callable[[], None],
    first: float,
    prepare: Callable[[], None] | None = None,
) -> dict[str, Any]:
    """Time an environment and the bare engine on the same states; seconds are medians over the blocks.

    Args:
        env: The environment.
        blocks: How often.
        act: Sets the actions of step t of a block.
        block: Makes the steps of a block, with those actions.
        first: Seconds until the environment's first step was done.
        prepare: Chooses the actions of the next block, in steps that are taken back; off the clock.
    """
    bare = bare_engine(env)
    whole, alone = [], []
    warm = max(2, env.horizon // 500)  # graphs are captured, and states are no longer the first ones
    for repetition in range(warm + blocks):
        start = env.get_state()
        if prepare is not None:
            prepare()
            env.set_state(start)
        time_env = seconds(env, block)
        env.set_state(start)
        snapshots = []
        for t in range(BLOCK):
            act(t)
            snapshots.append(bare.snapshot())
            env.step()
        time_bare = 0.0
        for snapshot in snapshots:
            bare.load(snapshot)
            time_bare += seconds(env, bare.step)
        if repetition >= warm:
            whole.append(time_env / BLOCK)
            alone.append(time_bare / BLOCK)
    kept = statistics.median(b / a for a, b in zip(whole, alone, strict=True))
    step, step_alone = statistics.median(whole), statistics.median(alone)
    added = statistics.median(a - b for a, b in zip(whole, alone, strict=True)) * 1e6
    rate = env.nworld / step
    return {
        "env_steps_per_second": rate,
        "bare_steps_per_second": env.nworld / step_alone,
        "kept": kept,
        "added_microseconds": added,
        "refresh": refresh_seconds(env) / step,
        "bytes_per_world": env.bytes_per_world,
        "first_step_seconds": first,  # with a cold cache, mostly compilation
    }


def refresh_seconds(env: lw.Env) -> float:
    """Seconds of a step's refreshes alone; on the Warp engine for the worlds that restarted in the last step, too."""
    engine = env.engine
    if isinstance(engine, MujocoEngine):
        refresh: Callable[[], object] = engine.compute_stage
        stages = (engine.stage,)
    else:
        assert isinstance(engine, WarpEngine)
        stages = (engine.stage, engine.reset_stage)
        with wp.ScopedDevice(env.device), wp.ScopedCapture() as capture:
            engine.refresh_current(env.worlds.everyone)
            engine.refresh(env.worlds.restarting)
        refresh = partial(wp.capture_launch, capture.graph)
    if not any(stages):
        return 0.0
    return statistics.median(seconds(env, refresh) for _ in range(30))


def first_step(setting: Setting) -> tuple[lw.Env, float]:
    """The environment, and the seconds until its first step was done."""
    began = time.perf_counter()
    place = {"nthread": setting.nthread} if setting.engine == "mujoco" else {"device": setting.device}
    env = lw.make(FILES.get(setting.task, setting.task), nworld=setting.nworld, engine=setting.engine, **place)
    first = time.perf_counter() - began + seconds(env, env.step)
    if setting.apart:
        state = env.get_state()
        step = env.state_space.split(state)["step"]
        step.copy_(torch.randint(0, env.horizon, step.shape, device=state.device))
        env.set_state(state)
    return env, first


def measure(setting: Setting) -> dict[str, Any]:
    """What of the bare engine's rate is kept."""
    env, first = first_step(setting)
    if setting.npg:
        npg = lw.NPG(env, config=lw.NPGConfig(samples=BLOCK * setting.nworld, mean_every=0))
        return compare(
            env, setting.blocks, lambda t: npg.policy.sample(env.obs, npg.noise[t], out=env.action), npg.sample, first
        )
    actions = contestants.actions(env, seed=0)
    policy = None if setting.policy is None else lw.load(setting.policy).to(env.obs.device)

    def block() -> None:
        for t in range(BLOCK):
            env.action.copy_(actions[t])
            env.step()

    @torch.no_grad()
    def follow() -> None:
        """Steps of the policy, whose actions become those of the block."""
        for t in range(BLOCK):
            actions[t].copy_(policy(env.obs))
            env.step(actions[t])

    if policy is not None:
        for _ in range(FOLLOWED // BLOCK):  # into states of the policy's own
            follow()
    prepare = None if policy is None else follow
    return compare(env, setting.blocks, lambda t: env.action.copy_(actions[t]), block, first, prepare)
