"""What a step costs, beside the bare engine on the same states and beside Gymnasium's vector environments.

    python bench/throughput.py --tasks hopper humanoid --nworld 256

Environment and bare engine take turns: before each step the state that the environment is about to leave is
copied into the bare engine outside the clock, so that both step the same states, resets included, on a machine
of the same mood. The bare engine is ``mujoco.batch.Batch.step`` or one graph of ``mujoco_warp.step``, with the
same model, controls and number of substeps. ``kept`` is bare time by environment time; ``added`` the difference.
"""

import dataclasses
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import tyro
import warp as wp
from mujoco.batch import Batch
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw
from lyceum_warp.engines.c import MujocoEngine
from lyceum_warp.engines.warp import WarpEngine
from lyceum_warp.runs import versions

GYMNASIUM = {
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
    "half_cheetah": "HalfCheetah-v5",
    "swimmer": "Swimmer-v5",
    "humanoid": "Humanoid-v5",
}


@dataclasses.dataclass(frozen=True)
class Options:
    """Throughput of environments, as a table and as JSON."""

    tasks: tuple[str, ...] = (*GYMNASIUM, "cartpole_swingup", "point_mass")
    """Tasks to measure."""
    nworld: tuple[int, ...] = (256,)
    """Numbers of worlds."""
    engine: str = "auto"
    """Engine."""
    device: str = "cpu"
    """Device."""
    steps: int = 50
    """Steps in a repetition."""
    repeat: int = 5
    """Repetitions; medians are printed."""
    gymnasium: bool = True
    """Whether to measure Gymnasium's vector environments, too."""
    npg: bool = True
    """Whether to measure NPG's sampling on the first task, too."""
    out: Path | None = None
    """JSON file for the record."""


class BareC:
    """``mujoco.batch.Batch`` alone, on the states of an environment's C engine."""

    def __init__(self, env: lw.Env) -> None:
        self.env, engine = env, env.engine
        assert isinstance(engine, MujocoEngine)
        self.rows = engine.batch.state
        self.batch = Batch(engine.batch.model, env.nworld, engine.nthread)

    def load(self) -> None:
        """Take over states and actions before the environment's step; not part of the measurement."""
        self.batch.state[:] = self.rows
        low, high = self.env.action_space.low, self.env.action_space.high
        self.batch.ctrl[:] = np.clip(self.env.action.numpy(), low, high)

    def step(self) -> None:
        self.batch.step(nstep=self.env.task.frame_skip)


class BareWarp:
    """A graph of ``mujoco_warp.step`` alone, on the states of an environment's Warp engine."""

    def __init__(self, env: lw.Env) -> None:
        self.env, engine = env, env.engine
        assert isinstance(engine, WarpEngine)
        self.spec = mujoco.mjtState.mjSTATE_INTEGRATION.value
        with wp.ScopedDevice(env.device):
            self.m = mjw.put_model(env.model)
            self.m.opt.warn_overflow = 0
            self.d = mjw.make_data(env.model, nworld=env.nworld, nconmax=engine.nconmax, njmax=engine.njmax)
            self.state = wp.zeros((env.nworld, engine.integration_size), dtype=float)
            mjw.step(self.m, self.d)
            with wp.ScopedCapture() as capture:
                for _ in range(env.task.frame_skip):
                    mjw.step(self.m, self.d)
        self.graph = capture.graph
        low, high = env.action_space.low, env.action_space.high
        self.low, self.high = (torch.as_tensor(x, device=env.obs.device) for x in (low, high))

    def load(self) -> None:
        engine = self.env.engine
        assert isinstance(engine, WarpEngine)
        with wp.ScopedDevice(self.env.device):
            mjw.get_state(engine.m, engine.d, self.state, self.spec)
            mjw.set_state(self.m, self.d, self.state, self.spec)
        wp.to_torch(self.d.ctrl).copy_(self.env.action.clamp(self.low, self.high))
        synchronize(self.env)

    def step(self) -> None:
        wp.capture_launch(self.graph)


def bare_engine(env: lw.Env) -> BareC | BareWarp:
    return BareC(env) if isinstance(env.engine, MujocoEngine) else BareWarp(env)


def synchronize(env: lw.Env) -> None:
    if not env.device.is_cpu:
        wp.synchronize_device(env.device)


def seconds(env: lw.Env, function: Callable[[], None]) -> float:
    start = time.perf_counter()
    function()
    synchronize(env)
    return time.perf_counter() - start


@dataclasses.dataclass(frozen=True)
class Row:
    """One measurement; times are seconds a step, medians over the repetitions."""

    task: str
    engine: str
    nworld: int
    env_steps_per_second: float
    bare_steps_per_second: float
    kept: float
    added_microseconds: float


def measure_env(task: str, nworld: int, options: Options) -> Row:
    env = lw.make(task, nworld=nworld, engine=options.engine, device=options.device)
    bare = bare_engine(env)
    generator = torch.Generator(env.obs.device).manual_seed(0)
    low, high = (torch.as_tensor(x, device=env.obs.device) for x in (env.action_space.low, env.action_space.high))
    uniform = torch.empty_like(env.action)

    turn = 0

    def one_step() -> tuple[float, float]:
        nonlocal turn
        env.action.copy_(uniform.uniform_(generator=generator) * (high - low) + low)
        bare.load()
        turn += 1  # whoever goes second finds the caches warm
        if turn % 2:
            return seconds(env, env.step), seconds(env, bare.step)
        alone = seconds(env, bare.step)
        return seconds(env, env.step), alone

    for _ in range(max(20, env.horizon // 50)):  # recordings, and states that are no longer the first ones
        one_step()
    whole, alone = [], []
    for _ in range(options.repeat):
        times = [one_step() for _ in range(options.steps)]
        whole.append(sum(t[0] for t in times) / options.steps)
        alone.append(sum(t[1] for t in times) / options.steps)
    kept = statistics.median(b / a for a, b in zip(whole, alone, strict=True))
    added = statistics.median(a - b for a, b in zip(whole, alone, strict=True)) * 1e6
    rates = nworld / statistics.median(whole), nworld / statistics.median(alone)
    return Row(task, env.engine.name, nworld, *rates, kept, added)


def measure_sampling(task: str, nworld: int, options: Options) -> Row:
    """NPG's sampling with the policy's forward passes, beside the bare engine on the same states."""
    env = lw.make(task, nworld=nworld, engine=options.engine, device=options.device)
    npg = lw.NPG(env, config=lw.NPGConfig(samples=options.steps * nworld, mean_every=0))
    bare = bare_engine(env)
    noise = npg.noise
    whole, alone = [], []
    for _ in range(options.repeat + 1):
        noise.normal_(generator=npg.generator)
        start = env.get_state()
        whole.append(seconds(env, lambda: npg.rollout.collect(npg.policy, noise)) / options.steps)
        env.set_state(start)
        total = 0.0
        for t in range(options.steps):
            npg.policy.sample(env.obs, noise[t], out=env.action)
            bare.load()
            total += seconds(env, bare.step)
            env.step()
        alone.append(total / options.steps)
    whole, alone = whole[1:], alone[1:]  # the first repetition makes the recordings
    kept = statistics.median(b / a for a, b in zip(whole, alone, strict=True))
    added = statistics.median(a - b for a, b in zip(whole, alone, strict=True)) * 1e6
    rates = nworld / statistics.median(whole), nworld / statistics.median(alone)
    return Row(f"{task}, sampling of NPG", env.engine.name, nworld, *rates, kept, added)


def measure_gymnasium(name: str, steps: int) -> tuple[str, float]:
    """Environment steps per second of the best of Gymnasium's vector modes."""
    results = {}
    for mode, n in (("sync", 16), ("async", 2), ("async", 16)):
        envs = gymnasium.make_vec(name, num_envs=n, vectorization_mode=mode)
        envs.reset(seed=0)
        envs.action_space.seed(0)
        for _ in range(10):
            envs.step(envs.action_space.sample())
        actions = [envs.action_space.sample() for _ in range(steps)]
        start = time.perf_counter()
        for action in actions:
            envs.step(action)
        results[f"{mode} {n}"] = steps * n / (time.perf_counter() - start)
        envs.close()
    return max(results.items(), key=lambda item: item[1])


def main(options: Options) -> None:
    console = Console(width=130)
    rows: list[Row] = []
    table = Table("task", "engine", "worlds", "env steps/s", "bare steps/s", "kept", "added, µs", "Gymnasium", "ratio")
    for column in table.columns[2:7]:
        column.justify = "right"
    baseline: dict[str, tuple[str, float]] = {}
    for task in options.tasks:
        for nworld in options.nworld:
            row = measure_env(task, nworld, options)
            rows.append(row)
            other = ["", ""]
            if options.gymnasium and task in GYMNASIUM:
                if task not in baseline:
                    baseline[task] = measure_gymnasium(GYMNASIUM[task], 300)
                mode, rate = baseline[task]
                other = [f"{rate:,.0f} ({mode})", f"{row.env_steps_per_second / rate:.1f}"]
            table.add_row(*cells(row), *other)
    if options.npg:
        rows.append(measure_sampling(options.tasks[0], options.nworld[0], options))
        table.add_row(*cells(rows[-1]), "", "")
    console.print(table)
    if options.out is not None:
        gym = {task: {"mode": mode, "env_steps_per_second": rate} for task, (mode, rate) in baseline.items()}
        record = {"versions": versions(), "rows": [dataclasses.asdict(row) for row in rows], "gymnasium": gym}
        options.out.write_text(json.dumps(record, indent=2) + "\n")


def cells(row: Row) -> list[str]:
    rates = f"{row.env_steps_per_second:,.0f}", f"{row.bare_steps_per_second:,.0f}"
    return [row.task, row.engine, str(row.nworld), *rates, f"{row.kept:.3f}", f"{row.added_microseconds:,.0f}"]


if __name__ == "__main__":
    main(tyro.cli(Options))
