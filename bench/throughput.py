"""What a step costs, beside the bare engine on the same states and beside Gymnasium's vector environments.

    python bench/throughput.py --tasks hopper humanoid --nworld 256

Environment and bare engine take turns of ten steps: each state that the environment starts a step from is copied to
the bare engine, outside the clock, so that both step the same states, resets included, under the same load of the
machine. The bare engine is ``mujoco.batch.Batch.step`` or one graph of ``mujoco_warp.step``, with the same model,
controls and number of substeps. ``kept`` is bare time by environment time; ``added`` is the difference. ``refresh`` is
the time for fields that ``mj_step`` leaves behind, as a share of the step. On the Warp engine it counts those of the
new state where the task reads positions, and a forward pass of the restarted worlds where it reads forces; what the
next step takes over is counted, too. On the C engine it is what ``Batch.step`` itself takes longer if it computes the
stage that the task needs.

Beside the package's tasks there is ``quadruped``, dm_control's, which reads sensors; dm_control must be installed.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import gymnasium
import measurements
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
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.engines.warp.warp_engine import WarpEngine
from lyceum_warp.fields import Stage

GYMNASIUM = {
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
    "half_cheetah": "HalfCheetah-v5",
    "swimmer": "Swimmer-v5",
    "ant": "Ant-v5",
    "humanoid": "Humanoid-v5",
}

FILES = {"quadruped": Path(__file__).with_name("quadruped.py")}
"""Tasks of this folder."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Throughput of environments, as a table and as JSON."""

    tasks: tuple[str, ...] = (*GYMNASIUM, "cartpole", "herb_reach", "cartpole_swingup", "point_mass")
    """Tasks to measure."""
    nworld: tuple[int, ...] = (256,)
    """Numbers of worlds."""
    engine: str = "auto"
    """Engine."""
    device: str = "cpu"
    """Device."""
    blocks: int = 50
    """Blocks of ten steps; medians over them are printed."""
    apart: bool = False
    """Whether the worlds are at different steps of their episodes, so that some restart in every step."""
    gymnasium: bool = True
    """Whether to measure Gymnasium's vector environments, too."""
    npg: bool = True
    """Whether to measure NPG's sampling on the first task, too."""
    out: Path | None = None
    """JSON file for the results."""


def action_bounds(env: lw.Env) -> list[torch.Tensor]:
    """Lowest and highest action, (nact,) each; -1 and 1 where there are no bounds."""
    bounds = (torch.as_tensor(x, device=env.obs.device) for x in (env.action_space.low, env.action_space.high))
    return [bound.nan_to_num(posinf=1.0, neginf=-1.0) for bound in bounds]


def next_controls(env: lw.Env) -> torch.Tensor:
    """The controls of the environment's next step, (nworld, nu)."""
    if (control := env.task.kernels.control_worlds) is None:
        low, high = (torch.as_tensor(x, device=env.obs.device) for x in (env.action_space.low, env.action_space.high))
        return env.action.clamp(low, high)
    controls = wp.zeros_like(env.engine.ctrl)
    args = [env.worlds.after, env.worlds.params, env.worlds.action, controls]
    wp.launch(control, env.nworld, args, device=env.device)
    return wp.to_torch(controls)


class BareC:
    """``mujoco.batch.Batch`` alone, on the states of an environment's C engine."""

    def __init__(self, env: lw.Env) -> None:
        self.env, engine = env, env.engine
        assert isinstance(engine, MujocoEngine)
        self.rows = engine.batch.state
        self.batch = Batch(engine.batch.model, env.nworld, engine.nthread)
        self.stage = engine.stage
        self.staged = Batch(engine.batch.model, env.nworld, engine.nthread, engine.batch.persistent)

    def snapshot(self) -> tuple[np.ndarray, np.ndarray]:
        """States and controls of the environment's next step."""
        return self.rows.copy(), next_controls(self.env).numpy()

    def load(self, snapshot: tuple[np.ndarray, np.ndarray]) -> None:
        self.batch.state[:], self.batch.ctrl[:] = snapshot

    def step(self) -> None:
        self.batch.step(nstep=self.env.task.frame_skip)

    def load_staged(self, snapshot: tuple[np.ndarray, np.ndarray]) -> None:
        """Make ready for a step that goes on from the stage which the last one computed."""
        self.staged.state[:], self.staged.ctrl[:] = snapshot
        self.staged.forward(stage=self.stage)

    def step_staged(self) -> None:
        """A step that computes the stage which the task needs."""
        self.staged.step(nstep=self.env.task.frame_skip, stage=self.stage)


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
    physics_steps_per_second: float
    """Substeps of all worlds."""
    bytes_per_world: float
    refresh: float
    """Share of the step for fields that the bare engine does not bring up to date."""
    first_step_seconds: float
    """Until the environment was made and its first step was done: with a cold cache, mostly compilation."""


BLOCK = 10
"""Steps after which environment and bare engine change places."""


def measure(
    env: lw.Env, name: str, options: Options, act: Callable[[int], None], block: Callable[[], None], first: float
) -> Row:
    """Time an environment and the bare engine on the same states.

    Args:
        env: The environment.
        name: What the row is called.
        options: How often.
        act: Sets the actions of step t of a block.
        block: Makes the steps of a block, with those actions.
        first: Seconds until the environment's first step was done.
    """
    bare = bare_engine(env)
    whole, alone, staged = [], [], []
    warm = max(2, env.horizon // 500)  # graphs are captured, and states are no longer the first ones
    for repetition in range(warm + options.blocks):
        start = env.get_state()
        time_env = seconds(env, block)
        env.set_state(start)
        snapshots = []
        for t in range(BLOCK):
            act(t)
            snapshots.append(bare.snapshot())
            env.step()
        time_bare = time_staged = 0.0
        for snapshot in snapshots:
            bare.load(snapshot)
            time_bare += seconds(env, bare.step)
            if isinstance(bare, BareC) and bare.stage > Stage.NONE:
                bare.load_staged(snapshot)
                time_staged += seconds(env, bare.step_staged)
        if repetition >= warm:
            staged.append((time_staged or time_bare) / BLOCK)
            whole.append(time_env / BLOCK)
            alone.append(time_bare / BLOCK)
    kept = statistics.median(b / a for a, b in zip(whole, alone, strict=True))
    step, step_alone = statistics.median(whole), statistics.median(alone)
    added = statistics.median(a - b for a, b in zip(whole, alone, strict=True)) * 1e6
    rate = env.nworld / step
    longer = statistics.median(c - b for b, c in zip(alone, staged, strict=True))
    refresh = refresh_seconds(env) if isinstance(env.engine, WarpEngine) else longer
    return Row(
        name, env.engine.name, env.nworld, rate, env.nworld / step_alone, kept, added, rate * env.task.frame_skip,
        env.bytes_per_world, refresh / step, first,
    )  # fmt: skip


def refresh_seconds(env: lw.Env) -> float:
    """Seconds of a step's refreshes alone, for the worlds that restarted in the last step."""
    engine = env.engine
    assert isinstance(engine, WarpEngine)
    if engine.stage == engine.reset_stage == Stage.NONE:
        return 0.0
    with wp.ScopedDevice(env.device), wp.ScopedCapture() as capture:
        engine.refresh_current(env.worlds.everyone)
        engine.refresh(env.worlds.restarting)
    times = [seconds(env, lambda: wp.capture_launch(capture.graph)) for _ in range(30)]
    return statistics.median(times)


def first_step(task: str, nworld: int, options: Options) -> tuple[lw.Env, float]:
    began = time.perf_counter()
    env = lw.make(FILES.get(task, task), nworld=nworld, engine=options.engine, device=options.device)
    first = time.perf_counter() - began + seconds(env, env.step)
    if options.apart:
        state = env.get_state()
        step = env.state_space.split(state)["step"]
        step.copy_(torch.randint(0, env.horizon, step.shape, device=state.device))
        env.set_state(state)
    return env, first


def measure_env(task: str, nworld: int, options: Options) -> Row:
    env, first = first_step(task, nworld, options)
    generator = torch.Generator(env.obs.device).manual_seed(0)
    low, high = action_bounds(env)
    draws = torch.rand(BLOCK, *env.action.shape, generator=generator, device=env.obs.device)
    actions = draws * (high - low) + low

    def act(t: int) -> None:
        env.action.copy_(actions[t])

    def block() -> None:
        for t in range(BLOCK):
            act(t)
            env.step()

    return measure(env, task, options, act, block, first)


def measure_sampling(task: str, nworld: int, options: Options) -> Row:
    """NPG's sampling: the policy's forward passes, the noise and the rollout buffer are part of it."""
    env, first = first_step(task, nworld, options)
    npg = lw.NPG(env, config=lw.NPGConfig(samples=BLOCK * nworld, mean_every=0))

    def act(t: int) -> None:
        npg.policy.sample(env.obs, npg.noise[t], out=env.action)

    return measure(env, f"{task}, sampling of NPG", options, act, npg.sample, first)


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
    console = Console(width=160)
    rows: list[Row] = []
    table = Table("task", "engine", "worlds", "env steps/s", "bare steps/s", "kept", "added, µs", "refresh",
                  "physics/s", "kB/world", "first, s", "Gymnasium", "ratio")  # fmt: skip
    for column in table.columns[2:11]:
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
        measurements.write(options.out, rows, options.device, gymnasium=gym)


def cells(row: Row) -> list[str]:
    rates = f"{row.env_steps_per_second:,.0f}", f"{row.bare_steps_per_second:,.0f}"
    more = f"{row.physics_steps_per_second:,.0f}", f"{row.bytes_per_world / 1e3:,.1f}", f"{row.first_step_seconds:.1f}"
    numbers = f"{row.kept:.3f}", f"{row.added_microseconds:,.0f}", f"{row.refresh:.1%}"
    return [row.task, row.engine, str(row.nworld), *rates, *numbers, *more]


if __name__ == "__main__":
    main(tyro.cli(Options))
