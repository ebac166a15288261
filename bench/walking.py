"""How well policies of go1_velocity walk, measured as mjlab's policy was.

    python bench/walking.py runs/go1 --device cuda --nworld 4096

The mean policy acts in the task as it is trained, with noise, pushes and random robots, from an episode's first step
on: 500 steps, 10 s, are half an episode. A fall is an episode that ends because the trunk tilts too far.
"""

import dataclasses
import statistics
from pathlib import Path

import measurements
import torch
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw


@dataclasses.dataclass(frozen=True)
class Options:
    """Tracking errors and falls of policies."""

    policies: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of runs, or files of policies."""
    task: str = "go1_velocity"
    """Task: a name, or a file, with go1_velocity's metrics."""
    nworld: int = 1024
    """Worlds."""
    steps: int = 500
    """Steps of each world."""
    device: str = "cpu"
    """Device."""
    engine: str = "auto"
    """Engine."""
    seed: int = 1000
    """Seed of the robots, the commands and the pushes."""
    out: Path | None = None
    """JSON file for the results."""


@dataclasses.dataclass(frozen=True)
class Row:
    """What one policy does."""

    policy: str
    velocity_error: float
    """Mean length of the difference between commanded and horizontal velocity, m/s."""
    yaw_rate_error: float
    """Mean difference between commanded yaw rate and the trunk's, rad/s."""
    falls_per_world_second: float
    return_per_1000_steps: float
    """Mean reward of a step by 1,000: the return of an episode that lasts."""


@torch.no_grad()
def measure(options: Options, path: Path) -> Row:
    """Step worlds of their own under a policy.

    Raises:
        RuntimeError: A world had a fault.
    """
    env = lw.make(options.task, nworld=options.nworld, seed=options.seed, device=options.device, engine=options.engine)
    policy = lw.load(path).to(env.obs.device)
    sums = torch.zeros(4, dtype=torch.float64, device=env.obs.device)
    for _ in range(options.steps):
        env.action.copy_(policy(env.obs))
        env.step()
        errors = (env.metrics["velocity_error"], env.metrics["yaw_rate_error"], env.terminated, env.reward)
        sums += torch.stack([error.double().mean() for error in errors])
    if counts := {name: count for name, count in env.fault_counts.items() if count}:
        raise RuntimeError(f"worlds of {options.task} had faults, {counts}: the figures would not be those of the task")
    velocity, yaw_rate, falls, reward = (sums / options.steps).tolist()
    return Row(str(path), velocity, yaw_rate, falls / env.timestep, 1000 * reward)


def main(options: Options) -> None:
    rows = [measure(options, path) for path in options.policies]
    table = Table("policy", "velocity error, m/s", "yaw rate error, rad/s", "falls a world-second", "return")
    for row in rows:
        table.add_row(row.policy, *(f"{value:.4g}" for value in dataclasses.astuple(row)[1:]))
    means = [statistics.mean(values) for values in list(zip(*map(dataclasses.astuple, rows), strict=True))[1:]]
    if len(rows) > 1:
        table.add_row("mean", *(f"{value:.4g}" for value in means))
    Console().print(table)
    if options.out is not None:
        settings = {"task": options.task, "nworld": options.nworld, "steps": options.steps, "seed": options.seed}
        measurements.write(options.out, rows, options.device, options=settings)


if __name__ == "__main__":
    main(tyro.cli(Options))
