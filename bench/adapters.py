"""Stable-Baselines3's PPO through its adapter, beside the same PPO on Gymnasium's environments.

    python bench/adapters.py --nworld 16 64
    python bench/adapters.py --nworld 256 --samples 8192 --batch-size 1024 --epochs 5

The learners take turns of one iteration each: a rollout and its update. Gymnasium's environments run in
Stable-Baselines3's own vector environments: DummyVecEnv steps them one after another, SubprocVecEnv in a process each.
All of them have the same hyperparameters. With Stable-Baselines3's defaults most of the time goes to the update, which
is the same for all of them; therefore the rollouts, with their policy, are timed alone, too. The first iteration of
each is left out, because it compiles kernels and starts processes.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import measurements
import torch
import tyro
from rich.console import Console
from rich.table import Table
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from lyceum_warp.adapters.stable_baselines3 import StableBaselines3VecEnv
from lyceum_warp.binding.registry import find_task


@dataclasses.dataclass(frozen=True)
class Options:
    """PPO's samples a second, as a table and as JSON."""

    task: str = "hopper"
    """A task of Gymnasium's."""
    nworld: tuple[int, ...] = (16, 64)
    """Numbers of worlds."""
    processes: int = 16
    """The largest number of worlds for which SubprocVecEnv, with a process for each, is measured, too."""
    samples: int = 2048
    """Samples an iteration, of all worlds together."""
    batch_size: int = 64
    """Samples of a minibatch; the default is Stable-Baselines3's."""
    epochs: int = 10
    """Epochs of an update; the default is Stable-Baselines3's."""
    turns: int = 5
    """Iterations of each; medians over them are printed."""
    threads: int = 1
    """Threads of torch, whose networks are small here. The environments use all cores."""
    seed: int = 0
    """Seed of the worlds and of PPO."""
    out: Path | None = None
    """JSON file for the results."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One way to run the environments."""

    task: str
    nworld: int
    environments: str
    samples_per_second: float
    rollout_samples_per_second: float
    """Of the rollouts alone, with the policy."""
    slowest: float
    """Samples a second of the slowest iteration."""
    fastest: float


class RolloutClock(BaseCallback):
    """The seconds of the last rollout."""

    seconds = 0.0

    def _on_rollout_start(self) -> None:
        self._start = time.perf_counter()

    def _on_rollout_end(self) -> None:
        self.seconds = time.perf_counter() - self._start

    def _on_step(self) -> bool:
        return True


class Learner:
    """PPO on one kind of environments.

    Args:
        env: The environments.
        options: The options of this program.
    """

    def __init__(self, env: VecEnv, options: Options) -> None:
        self.env, self.options, self.clock = env, options, RolloutClock()
        steps = options.samples // env.num_envs
        self.model = PPO(
            "MlpPolicy", env, n_steps=steps, batch_size=options.batch_size, n_epochs=options.epochs, seed=options.seed,
            device="cpu",
        )  # fmt: skip
        self.samples = steps * env.num_envs
        self.seconds: list[float] = []
        self.rollout_seconds: list[float] = []

    def iterate(self) -> None:
        """One iteration."""
        start = time.perf_counter()
        self.model.learn(self.samples, callback=self.clock, reset_num_timesteps=False)
        self.seconds.append(time.perf_counter() - start)
        self.rollout_seconds.append(self.clock.seconds)

    def row(self, environments: str) -> Row:
        """Medians over all iterations but the first."""
        rates = [self.samples / seconds for seconds in self.seconds[1:]]
        rollouts = [self.samples / seconds for seconds in self.rollout_seconds[1:]]
        return Row(
            self.options.task, self.env.num_envs, environments, statistics.median(rates), statistics.median(rollouts),
            min(rates), max(rates),
        )  # fmt: skip


def measure(options: Options, nworld: int) -> list[Row]:
    id = find_task(options.task).gymnasium
    assert id is not None, f"{options.task!r} is not a task of Gymnasium's"
    makers: dict[str, Callable[[], VecEnv]] = {
        "lyceum_warp": lambda: StableBaselines3VecEnv(options.task, nworld),
        "DummyVecEnv": lambda: make_vec_env(id, nworld, vec_env_cls=DummyVecEnv),
    }
    if nworld <= options.processes:
        makers["SubprocVecEnv"] = lambda: make_vec_env(id, nworld, vec_env_cls=SubprocVecEnv)
    learners = {name: Learner(make(), options) for name, make in makers.items()}
    for _ in range(options.turns + 1):
        for learner in learners.values():
            learner.iterate()
    for learner in learners.values():
        learner.env.close()
    return [learner.row(name) for name, learner in learners.items()]


def main(options: Options) -> None:
    torch.set_num_threads(options.threads)
    rows = [row for nworld in options.nworld for row in measure(options, nworld)]
    table = Table("task", "worlds", "environments", "samples/s", "slowest to fastest", "rollouts alone, samples/s")
    for row in rows:
        numbers = f"{row.samples_per_second:,.0f}", f"{row.slowest:,.0f} to {row.fastest:,.0f}"
        rollouts = f"{row.rollout_samples_per_second:,.0f}"
        table.add_row(row.task, str(row.nworld), row.environments, *numbers, rollouts)
    Console().print(table)
    if options.out is not None:
        names = ("samples", "batch_size", "epochs", "turns", "threads")
        settings = {name: getattr(options, name) for name in names}
        measurements.write(options.out, rows, **settings)


if __name__ == "__main__":
    main(tyro.cli(Options))
