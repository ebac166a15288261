"""The cost of a plan beside the bare engine on the same rollouts, and beside MPPI over single Python environments.

    python bench/planning.py --tasks reach adroit_pen

Planner and bare engine take turns at every step of a controlled episode. The bare engine is one call of
``mujoco.batch.Batch.rollout``, or one graph of ``mujoco_warp.step``, from the same state, under the same controls,
for the same samples, steps and substeps; setting the state and the controls is outside its clock. The baseline is a
careful planner without this package: an environment as in Gymnasium in each of as many processes as there are cores,
kept alive, one message for each plan and process, noise and weights in NumPy. It plans from the same states afterwards.
"""

import dataclasses
import itertools
import multiprocessing
import os
import statistics
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

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
from lyceum_warp.cli.arguments import parameter
from lyceum_warp.engines.c.mujoco_engine import MujocoEngine
from lyceum_warp.engines.warp.warp_engine import WarpEngine

STATE = mujoco.mjtState.mjSTATE_INTEGRATION.value


@dataclasses.dataclass(frozen=True)
class Options:
    """Cost of a plan, as a table and as JSON."""

    tasks: tuple[str, ...] = ("reach", "half_cheetah", "adroit_pen")
    """Tasks to measure, with their own settings of MPPI."""
    samples: tuple[int, ...] = (0,)
    """Numbers of samples; 0 for the task's own."""
    engine: str = "auto"
    """Engine."""
    device: str = "cpu"
    """Device."""
    nthread: int | None = None
    """Threads of the C engine, and processes of the baseline; all cores by default."""
    option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Other settings of MPPI or options of its worlds, as NAME=VALUE."""
    solver: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Other limits of the planner's constraint solver, as NAME=VALUE."""
    seconds: float = 60.0
    """Time for each measurement, at least ten plans."""
    baseline: bool = True
    """Whether to measure single Python environments, too."""
    out: Path | None = None
    """JSON file for the results."""


# the baseline: single environments with Gymnasium's step


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
    """An environment of Gymnasium or Gymnasium-Robotics, put into the planner's qpos and qvel."""

    def __init__(self, name: str) -> None:
        if name.startswith("Adroit"):
            import gymnasium_robotics

            gymnasium.register_envs(gymnasium_robotics)
        self.env: Any = gymnasium.make(name).unwrapped
        self.env.reset(seed=0)
        self.sizes = self.env.model.nq, self.env.model.nv

    def set_state(self, state: np.ndarray) -> None:
        data, (nq, nv) = self.env.data, self.sizes
        data.time = state[0]
        data.qpos[:], data.qvel[:] = state[1 : 1 + nq], state[1 + nq : 1 + nq + nv]

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return self.env.step(action)


BASELINES: dict[str, Callable[[mujoco.MjModel], Any]] = {
    "reach": ReachEnv,
    "half_cheetah": lambda model: GymnasiumEnv("HalfCheetah-v5"),
    "adroit_pen": lambda model: GymnasiumEnv("AdroitHandPen-v1"),
}


def work(pipe: Connection, task: str, samples: int, horizon: int, noise_scale: float, smooth: tuple, seed: int) -> None:
    """A process of the baseline: rolls out its share of the samples for every plan that it is sent."""
    env = BASELINES[task](lw.make(task, nthread=1).model)
    random = np.random.default_rng(seed)
    while (message := pipe.recv()) is not None:
        state, plan = message
        noise = noise_scale * random.standard_normal((samples, horizon, plan.shape[1]))
        for t in range(2, horizon):
            noise[:, t] = smooth[0] * noise[:, t] + smooth[1] * noise[:, t - 1] + smooth[2] * noise[:, t - 2]
        actions = np.clip(plan + noise, -1.0, 1.0)
        returns = np.zeros(samples)
        for k in range(samples):
            env.set_state(state)
            for t in range(horizon):
                returns[k] += env.step(actions[k, t])[1]
        pipe.send((returns, actions))


class Baseline:
    """MPPI over single environments in processes."""

    def __init__(self, task: str, plan: lw.MPPI, processes: int) -> None:
        self.temperature = plan.temperature
        self.plan = np.zeros(tuple(plan.actions.shape))
        context = multiprocessing.get_context("spawn")
        shares = np.diff(np.linspace(0, plan.samples, processes + 1).astype(int))
        self.pipes, self.processes = [], []
        for seed, share in enumerate(shares):
            pipe, other = context.Pipe()
            settings = (int(share), plan.horizon, plan.config.noise, plan.config.smoothing, seed)
            process = context.Process(target=work, args=(other, task, *settings), daemon=True)
            process.start()
            self.pipes.append(pipe)
            self.processes.append(process)
        self(plan.state_of().cpu().numpy())  # wait until every process is ready

    def __call__(self, state: np.ndarray) -> None:
        for pipe in self.pipes:
            pipe.send((state, self.plan))
        answers = [pipe.recv() for pipe in self.pipes]
        returns, actions = (np.concatenate(parts) for parts in zip(*answers, strict=True))
        weights = np.exp((returns - returns.max()) / self.temperature)
        self.plan = np.tensordot(weights / weights.sum(), actions, axes=1)
        self.plan = np.concatenate([self.plan[1:], np.zeros((1, self.plan.shape[1]))])

    def close(self) -> None:
        for pipe in self.pipes:
            pipe.send(None)
        for process in self.processes:
            process.join()


# the bare engines


class BareC:
    """One ``Batch.rollout`` of a plan's samples."""

    def __init__(self, plan: lw.MPPI) -> None:
        self.plan, engine, self.nstep = plan, plan.env.engine, plan.env.task.frame_skip
        assert isinstance(engine, MujocoEngine)
        self.size = engine.integration_size
        self.batch = Batch(engine.native_model, plan.samples, engine.nthread)
        self.control = np.zeros((plan.samples, plan.horizon * self.nstep, engine.model.nu))
        self.results = None

    def load(self, state: torch.Tensor) -> None:
        """The last plan's state and samples."""
        self.batch.state[:] = state[0, : self.size].numpy()
        self.control[:] = np.repeat(self.plan._loop._controls.numpy().transpose(1, 0, 2), self.nstep, axis=1)

    def __call__(self) -> None:
        self.results = self.batch.rollout(
            self.control.shape[1], self.control, record=["qpos", "qvel"], out=self.results
        )  # fmt: skip


class BareWarp:
    """One graph of ``mujoco_warp.step`` for a plan's samples."""

    def __init__(self, plan: lw.MPPI) -> None:
        env, engine = plan.env, plan.env.engine
        assert isinstance(engine, WarpEngine)
        self.plan, self.env, self.size = plan, env, engine.integration_size
        with wp.ScopedDevice(env.device):
            self.m, self.d = engine.bare()
            self.state = wp.zeros((env.nworld, self.size), dtype=float)
            self.controls = wp.zeros((plan.horizon, env.nworld, env.model.nu), dtype=float)
            mjw.step(self.m, self.d)
            with wp.ScopedCapture() as capture:
                for t in range(plan.horizon):
                    wp.copy(self.d.ctrl, self.controls[t])
                    for _ in range(env.task.frame_skip):
                        mjw.step(self.m, self.d)
        self.graph = capture.graph

    def load(self, state: torch.Tensor) -> None:
        wp.to_torch(self.state).copy_(state[:, : self.size].float())
        wp.copy(self.controls, self.plan._loop._controls)
        with wp.ScopedDevice(self.env.device):
            mjw.reset_data(self.m, self.d)
            mjw.set_state(self.m, self.d, self.state, STATE)
        synchronize(self.env)

    def __call__(self) -> None:
        wp.capture_launch(self.graph)


def synchronize(env: lw.Env) -> None:
    if not env.device.is_cpu:
        wp.synchronize_device(env.device)


@dataclasses.dataclass(frozen=True)
class Row:
    """One measurement; times are milliseconds, medians over the plans."""

    task: str
    engine: str
    samples: int
    horizon: int
    plans: int
    plan_ms: float
    plan_ms_p99: float | None
    """Where there were 200 plans."""
    bare_ms: float
    ratio: float
    """Median over the plans of the planner's time by the bare engine's."""
    python_ms: float | None
    python_by_plan: float | None
    python_by_bare: float | None


def measure(task: str, samples: int, options: Options) -> Row:
    more: dict[str, Any] = dict(map(parameter, options.option))
    if options.solver:
        more["solver"] = dict(map(parameter, options.solver))
    if samples:
        more["samples"] = samples
    if options.nthread is not None:
        more["nthread"] = options.nthread
    plan = lw.MPPI(task, engine=options.engine, device=options.device, **more)
    plant = lw.make(task, autoreset=False, engine=options.engine, device=options.device, seed=1)
    bare: BareC | BareWarp = (BareC if isinstance(plan.env.engine, MujocoEngine) else BareWarp)(plan)
    processes = options.nthread or os.cpu_count() or 1
    times: list[tuple[float, float]] = []
    states: list[np.ndarray] = []

    def timed(function: Callable[[], object]) -> float:
        synchronize(plant)
        start = time.perf_counter()
        function()
        synchronize(plant)
        return time.perf_counter() - start

    warm, began = 4, time.perf_counter()
    plan(before := plant.get_state())
    while len(times) < warm + 10 or time.perf_counter() - began < options.seconds:
        state = plant.get_state()
        # the first of the two wakes the threads, so they take turns at being first
        if first := len(times) % 2 == 0:
            spent = timed(lambda state=state: plan(state))
        bare.load(state if first else before)
        alone = timed(bare)
        if not first:
            spent = timed(lambda state=state: plan(state))
        before = state
        times.append((spent, alone))
        states.append(state[0].cpu().numpy())
        plant.step(plan.actions[:1])
        if plant.done.item():
            plant.rand_reset()
    times = times[warm:]
    spent_ms, bare_ms = (1e3 * statistics.median(t[i] for t in times) for i in (0, 1))
    python_ms = None
    if options.baseline and task in BASELINES:  # alone: its processes would compete for the caches
        baseline, began, taken = Baseline(task, plan, processes), time.perf_counter(), []
        for state in itertools.cycle(states):
            start = time.perf_counter()
            baseline(state)
            taken.append(time.perf_counter() - start)
            if len(taken) >= 10 and time.perf_counter() - began > options.seconds / 3:
                break
        baseline.close()
        python_ms = 1e3 * statistics.median(taken[2:])
    ordered = sorted(1e3 * t[0] for t in times)
    return Row(
        task, plan.env.engine.name, plan.samples, plan.horizon, len(times), spent_ms,
        ordered[int(0.99 * len(ordered))] if len(ordered) >= 200 else None, bare_ms,
        statistics.median(a / b for a, b in times), python_ms,
        python_ms and python_ms / spent_ms, python_ms and python_ms / bare_ms,
    )  # fmt: skip


def main(options: Options) -> None:
    console, rows = Console(width=140), []
    table = Table("task", "engine", "samples", "horizon", "plan, ms", "p99, ms", "bare, ms", "plan / bare",
                  "Python, ms", "Python / plan", "Python / bare")  # fmt: skip
    for column in table.columns[2:]:
        column.justify = "right"
    for task in options.tasks:
        for samples in options.samples:
            row = measure(task, samples, options)
            rows.append(row)
            numbers = (row.plan_ms, row.plan_ms_p99, row.bare_ms, row.ratio, row.python_ms, row.python_by_plan,
                       row.python_by_bare)  # fmt: skip
            table.add_row(task, row.engine, str(row.samples), str(row.horizon),
                          *("" if number is None else f"{number:.3f}" for number in numbers))  # fmt: skip
    console.print(table)
    if options.out is not None:
        measurements.write(options.out, rows, options.device)


if __name__ == "__main__":
    main(tyro.cli(Options))
