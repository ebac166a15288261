"""The time that a run's files take beside an iteration of NPG.

    python bench/saving.py humanoid --nworld 8192 --device cuda
    python bench/saving.py humanoid --nworld 8192 --samples 8192 --iterations 4

An iteration's time is that of ``next(npg)``. After an iteration the loop copies the state within the device, writes the
row and the policy, and now and then the complete state, with all worlds. The shares of training follow from the rules
by which the loop chooses the iterations.
"""

import dataclasses
import statistics
import tempfile
import time
from pathlib import Path

import torch
import tyro
from rich.console import Console
from rich.table import Table

import lyceum_warp as lw
from lyceum_warp.runs.folder import Run
from lyceum_warp.runs.saving import POLICY_SHARE, SHARE, Keeper


@dataclasses.dataclass(frozen=True)
class Options:
    """Seconds of iterations and of their files."""

    task: tyro.conf.Positional[str] = "humanoid"
    """Task."""
    nworld: int = 8192
    """Worlds."""
    device: str = "cpu"
    """Device."""
    samples: int | None = None
    """Samples in an iteration; NPG's default if not given."""
    iterations: int = 20
    """Iterations; the first two, which compile and allocate, do not count."""
    out: Path | None = None
    """Folder on the disk to be measured; by default one for temporary files."""


def main(options: Options) -> None:
    """Measure, and print the medians."""
    env = lw.make(options.task, nworld=options.nworld, device=options.device)
    npg = lw.NPG(env, config=lw.NPGConfig(samples=options.samples, mean_every=0))
    seconds: dict[str, list[float]] = {"iteration": [], "state": [], "files": [], "complete": []}

    with tempfile.TemporaryDirectory(dir=options.out) as folder:
        run = Run.create(Path(folder, "run"), {"task": options.task})
        keeper = Keeper(run, npg)
        for _ in range(options.iterations):
            times = [now(env)]
            iteration = next(npg)
            times.append(now(env))
            state = npg.state_dict()
            times.append(now(env))
            keeper.keep(iteration, state)
            times.append(now(env))
            keeper.save_state()
            times.append(now(env))
            for name, start, end in zip(seconds, times[:-1], times[1:], strict=True):
                seconds[name].append(end - start)
        sizes = run.policy_file().stat().st_size, run.checkpoint.stat().st_size

    medians = {name: statistics.median(values[2:] or values) for name, values in seconds.items()}
    table = Table("", "median", "share of an iteration", title=f"{options.task}, {options.nworld} worlds")
    renewal = medians["state"] + medians["files"]
    shares = {"files": min(renewal / medians["iteration"], 1.0 / POLICY_SHARE), "complete": 1.0 / SHARE}
    names = {"iteration": "iteration", "state": "copy of the state", "files": "row and policy",
             "complete": "complete state"}  # fmt: skip
    for name, median in medians.items():
        table.add_row(names[name], f"{1000 * median:.2f} ms", f"{shares[name]:.2%}" if name in shares else "")
    table.add_row("all files", "", f"{sum(shares.values()):.2%}")
    console = Console()
    console.print(table)
    console.print(f"policy.pt {sizes[0] / 1e6:.2f} MB, checkpoint.pt {sizes[1] / 1e6:.2f} MB")


def now(env: lw.Env) -> float:
    """The time, after all work on the device."""
    if env.obs.device.type == "cuda":
        torch.cuda.synchronize(env.obs.device)
    return time.perf_counter()


if __name__ == "__main__":
    main(tyro.cli(Options))
