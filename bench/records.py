"""Measure the seconds and samples from the start of ``lyceum-warp train`` until a policy reaches a threshold.

    lyceum-warp bench records --device cuda --tasks go1_velocity g1_velocity --seeds 42 43 44
    lyceum-warp bench records --tasks hopper --cache cold

The clock starts before the command, so the seconds include imports, compilation and graph captures. The clock stops
when the run's config.json says that the target is reached, or that a policy passes the gate of the task. The seconds
thus include all tests of policies. With a cold cache, the command compiles all kernels. Before a measurement with a
warm cache, one iteration of the same command fills the cache. A run that lasts longer than --seconds is stopped. The
same command continues it, and the result is the sum of the seconds. A run that does not reach its target within --limit
seconds is stored as well. Medians count it as slower than every run that reached the target.
"""

import contextlib
import dataclasses
import functools
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import experiment
from experiment import Experiment, Row, Skipped, Table, choose

from lyceum_warp.binding import file_name, package_task_names
from lyceum_warp.training import Run

WALKING = ("--mean-every", "0")
"""Command-line flags for walking robots, which must pass their gates."""
NPG = ("--algorithm", "npg", "--mean-every", "5")
"""Command-line flags for tasks whose threshold is a return without exploration noise, in 16 episodes."""
LARGE = (*NPG, "--samples", "65536")
LARGEST = (*NPG, "--nworld", "8192", "--samples", "131072")
FEWER_OBSERVATIONS = (
    *NPG, "--nworld", "128", "--samples", "20000",
    *(word for part in ("cinert", "cvel", "qfrc_actuator", "cfrc_ext")
      for word in ("--param", f"include_{part}_in_observation=false")),
)  # fmt: skip
"""Command-line flags for Gymnasium's humanoid with only positions and velocities as observations."""
FEW_WORLDS = (
    "--symmetry", "exact", "--nworld", "128", "--num-steps", "32", "--gate-every", "24",
    "--hidden", "128", "128", "--value-hidden", "128", "128", "--threads", "2",
)  # fmt: skip
PYRAMIDAL = ("--cone", "pyramidal")
"""Friction cones that halve the time of a Go1's step: with the elliptic cones of its model, the feet's contacts, which
also resist torsion and rolling, take most of it."""
EXACT_END = ("--gamma", "0.97", "--desired-kl", "0.04", "--param", "pose=0.3", "--exact-from", "200")
"""Fast learning under coarse physics, and an end under exact physics. Policies that have learned from few samples under
coarse physics fall in a few of 100 episodes under exact physics, mostly when they walk sideways. A larger KL divergence
and a smaller reward for the pose shorten the time in which the robot only stands."""
STRONG_TRACKING = (
    "--param", "track_linear_velocity=6", "--param", "action_rate_l2=-0.02", "--param", "foot_clearance=-0.5",
    "--param", "foot_swing_height=0",
)  # fmt: skip
"""Reward weights for few samples. With the default weights, some robots learn to stand instead of
walking."""
FEW_EPOCHS = (
    "--gamma", "0.97", "--desired-kl", "0.04", "--epochs", "3", "--entropy-coef", "0.006", "--gate-every", "36",
)  # fmt: skip
"""Updates that take less time than the samples: with five epochs, they take more on two cores."""
TWO_SUBSTEPS = ("--integrator", "discrete", "--frame-skip", "2", "--timestep", "0.01", "--exact-from", "144")
"""With one substep of 20 ms, an H1 falls in most episodes until it learns under exact physics."""
WIDE_EXPLORATION = (
    "--param", "track_angular_velocity=4", "--desired-kl", "0.04", "--log-std", "0", "--gate-every", "48",
    "--final-entropy-coef", "0.001", "--entropy-decay", "200", "400", "--param", "stages=[[0,-1.3,1.3,1]]",
)  # fmt: skip
"""Exploration that ends the time in which a T1 only stands, and then decreases, so that the robot walks precisely. It
falls mostly at 1 m/s, so that it also learns from larger commands."""
STRONG_TRACKING_GAIT = (
    "--param", "track_linear_velocity=10", "--param", "track_angular_velocity=5", "--param", "gait_clock=8",
    "--param", "roll_pitch_rate_l2=-0.4", "--param", "growth_steps=50000",
    "--param", "growing_joint_velocity_l2=-0.03", "--param", "growing_action_rate_l2=-4",
    "--gamma", "0.97", "--desired-kl", "0.04", "--log-std", "0", "--entropy-coef", "0.005",
    "--gate-every", "48", "--exact-from", "1000000", "--epochs", "3",
)  # fmt: skip
"""Reward weights and exploration for few samples, for robots with a gait clock. The costs of fast motion grow until the
policy passes. Each of few worlds makes many steps, so the growth takes more steps of a world. Exact physics, which the
task suggests after 350 iterations, takes twice as long."""
GROWING = (
    "--nworld", "8192", "--num-steps", "12", "--param", "growth_steps=12000",
    "--param", "growing_joint_velocity_l2=-0.018", "--param", "growing_action_rate_l2=-4.5",
)  # fmt: skip
"""Costs that grow beyond the weights of the task, until the policy passes."""
SMALL = (
    "--algorithm", "npg", "--mean-every", "25",
    "--samples", "2000", "--gamma", "0.99", "--lam", "0.95", "--log-std", "-1",
)  # fmt: skip
SUITE = (
    "--algorithm",
    "ppo",
    *WALKING,
    "--num-steps",
    "32",
    "--gamma",
    "0.995",
    "--entropy-coef",
    "0.001",
    "--no-clip-value-loss",
)

RECORDS: dict[str, dict[str, tuple[float | None, tuple[str, ...]]]] = {
    "go1_velocity": {
        "cpu": (None, (*WALKING, *FEW_WORLDS, *STRONG_TRACKING, *PYRAMIDAL, *EXACT_END)),
        "cuda": (None, WALKING),
    },
    "spot_velocity": {
        "cpu": (None, (*WALKING, *FEW_WORLDS, *STRONG_TRACKING, *PYRAMIDAL, *EXACT_END)),
        "cuda": (None, WALKING),
    },
    "h1_velocity": {
        "cpu": (None, (*WALKING, *FEW_WORLDS, *STRONG_TRACKING, *FEW_EPOCHS, *TWO_SUBSTEPS)),
        "cuda": (None, WALKING),
    },
    "g1_velocity": {
        "cpu": (None, (*WALKING, *FEW_WORLDS, *STRONG_TRACKING_GAIT)),
        "cuda": (None, (*WALKING, *GROWING)),
    },
    "t1_velocity": {
        "cpu": (None, (*WALKING, *FEW_WORLDS, *STRONG_TRACKING, *WIDE_EXPLORATION)),
        "cuda": (None, WALKING),
    },
    "inverted_pendulum": {"cpu": (950.0, NPG), "cuda": (950.0, LARGE)},
    "inverted_double_pendulum": {"cpu": (9000.0, NPG), "cuda": (9000.0, LARGE)},
    "reacher": {"cpu": (-6.5, NPG), "cuda": (-6.5, LARGE)},
    "pusher": {"cpu": (-38.0, NPG), "cuda": (-38.0, (*LARGE, "--nworld", "512"))},
    "swimmer": {"cpu": (150.0, NPG), "cuda": (150.0, (*LARGE, "--nworld", "512"))},
    "hopper": {"cpu": (1500.0, NPG), "cuda": (1500.0, LARGE)},
    "walker2d": {"cpu": (3000.0, NPG), "cuda": (3000.0, LARGE)},
    "half_cheetah": {"cpu": (4000.0, NPG), "cuda": (4000.0, LARGE)},
    "ant": {
        "cpu": (3000.0, (*SMALL, "--param", "include_cfrc_ext_in_observation=false")),
        "cuda": (4800.0, LARGEST),
    },
    "humanoid": {"cpu": (4500.0, FEWER_OBSERVATIONS), "cuda": (4500.0, LARGEST)},
    "humanoid_standup": {"cpu": (140000.0, NPG), "cuda": (140000.0, LARGEST)},
    **{name: {"cuda": (900.0, SUITE)} for name in package_task_names() if name.startswith("dm/")},
}
"""Maps each task and device to its threshold, which is None for the gate of the task, and to the flags for
`lyceum-warp train`."""

COMMON = ("--iterations", "1000000", "--no-video", "--no-plot")


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    cache: tuple[Literal["warm", "cold"], ...] = ("warm",)
    """State of the cache of compiled kernels."""
    seconds: float = 540.0
    """Seconds after which a run is stopped; the same command continues the run."""
    limit: float = 1800.0
    """Seconds after which a run is stored without having reached its target."""
    runs: Path = Path("runs/records")
    """Folder in which the runs are stored."""
    flags: str = ""
    """More flags for `lyceum-warp train`, as in --flags="--nworld 8192 --num-steps 12"."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    target: float | None
    """Threshold of the return, or None for the gate of the task."""
    seed: int
    cache: str
    device: str
    flags: str


def cases(options: Options) -> list[Case]:
    kind = options.device.partition(":")[0]
    tasks = choose(options.tasks, RECORDS, ("hopper",) if options.short else (), what="task")
    for task in options.tasks:
        if kind not in RECORDS[task]:
            raise ValueError(f"{task} has no target on {kind}: give --device {next(iter(RECORDS[task]))}")
    seeds = options.seeds or range(1 if options.short else 3)
    return [
        Case(task, 20.0 if options.short and target else target, seed, cache, kind,
             " ".join((*flags, *options.flags.split())))
        for task in tasks if kind in RECORDS[task] for target, flags in [RECORDS[task][kind]]
        for seed in seeds for cache in options.cache
    ]  # fmt: skip


def command(case: Case, folder: Path, device: str) -> list[str]:
    train = [sys.executable, "-m", "lyceum_warp.cli", "train"]
    if (folder / "checkpoint.pt").exists():
        return [*train, "--resume", str(folder), *COMMON]
    until = ("--gate-every", "10") if case.target is None else ("--target-return", str(case.target))
    return [
        *train, case.task, "--device", device, "--seed", str(case.seed), *until, *case.flags.split(),
        "--out", str(folder), *COMMON,
    ]  # fmt: skip


def measure(case: Case, options: Options) -> dict[str, Any]:
    """Train until the target or the limit is reached; raise Skipped after the time limit of this call."""
    name = f"{file_name(case.task)}-{case.device}-{case.cache}-{case.seed}"
    folder, notes = options.runs / name, options.runs / f"{name}.json"
    earlier = json.loads(notes.read_text()) if notes.exists() and (folder / "checkpoint.pt").exists() else [0.0, 0]
    if not earlier[1]:
        shutil.rmtree(folder, ignore_errors=True)  # an earlier call was killed and left this folder
    options.runs.mkdir(parents=True, exist_ok=True)
    left = min(options.seconds, options.limit - earlier[0])
    with cache(case, options, folder) as environment:
        reached, seconds = timed(command(case, folder, options.device), folder, environment, left)
    total, starts = earlier[0] + seconds, earlier[1] + 1
    if reached is None and total < options.limit:
        notes.write_text(json.dumps([total, starts]))
        raise Skipped(f"{name} has not reached its target after {total:.0f} s: repeat the command to continue")
    notes.unlink(missing_ok=True)
    gates = folder / "gate.jsonl"
    tests = [json.loads(line) for line in gates.read_text().splitlines()] if gates.exists() else []
    rows = [row for row in Run.open(folder).rows() if reached is None or row["iteration"] <= reached["iteration"]]
    learning = sum(row[part] or 0.0 for row in rows for part in row if part.startswith("time_"))
    return {
        "reached": reached is not None, "seconds": total, "samples": rows[-1]["samples"] if rows else 0,
        "return": reached and reached.get("return"), "learning_seconds": learning, "starts": starts,
        "tries": len(tests), "gate_seconds": sum(test["seconds"] for test in tests),
        "numbers": tests[-1]["numbers"] if tests else {},
    }  # fmt: skip


@contextlib.contextmanager
def cache(case: Case, options: Options, folder: Path) -> Iterator[dict[str, str]]:
    if case.cache == "warm":
        if not folder.exists():
            fill_cache(dataclasses.replace(case, seed=0), options.device)
        yield dict(os.environ)
        return
    with tempfile.TemporaryDirectory() as empty:
        caches = {"WARP_CACHE_PATH": "warp", "CUDA_CACHE_PATH": "cuda", "TORCHINDUCTOR_CACHE_DIR": "inductor"}
        yield os.environ | {name: f"{empty}/{folder}" for name, folder in caches.items()}


@functools.cache
def fill_cache(case: Case, device: str) -> None:
    """Run one iteration, once for all seeds."""
    with tempfile.TemporaryDirectory() as spare:
        once = command(case, Path(spare) / "run", device)
        once[once.index("--iterations") + 1] = "1"
        run(once, dict(os.environ)).wait()


def run(command: Sequence[str], environment: dict[str, str]) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)


def timed(
    command: Sequence[str], folder: Path, environment: dict[str, str], limit: float
) -> tuple[dict[str, Any] | None, float]:
    """Run the command until it reaches its target return, or for ``limit`` seconds.

    Return the entry "reached" of config.json, or None after the limit, and the seconds.
    """
    began, reached, stopped = time.perf_counter(), None, False
    process = run(command, environment)
    config = folder / "config.json"
    while True:
        code = process.poll()
        with contextlib.suppress(FileNotFoundError):
            content = json.loads(config.read_text())
            reached = content.get("reached", content.get("passed"))
        seconds = time.perf_counter() - began
        if reached is not None:
            process.wait()  # the process saves the policy and evaluates it
            return reached, seconds
        if stopped:
            return None, seconds
        if code is not None:
            raise RuntimeError(f"{' '.join(command)} ended with code {code} before it reached the target")
        if seconds > limit:
            process.send_signal(signal.SIGTERM)  # the process saves the run after the current iteration
            process.wait()
            stopped = True  # but it may have passed in this iteration
        time.sleep(0.05)


def tables(rows: Sequence[Row]) -> list[Table]:
    groups = experiment.grouped(rows, "task", "target", "device", "cache", "flags")
    lines = []
    for (task, target, device, cached, flags), same in groups.items():
        results = [row.result for row in same]
        lines.append([
            task, "gate" if target is None else f"{target:,g}", device, cached,
            " ".join(map(str, sorted(row.case["seed"] for row in same))),
            censored(results, "seconds", ".1f"), censored(results, "learning_seconds", ".1f"),
            censored(results, "samples", ".3g", 1e6), f"`{flags}`",
        ])  # fmt: skip
    header = ["task", "target", "device", "kernels", "seeds", "seconds from process start", "of these learning",
              "million samples", "flags of `lyceum-warp train`"]  # fmt: skip
    title = (
        "Until the mean return reaches a threshold: median over the seeds, with the smallest and the largest. A number "
        'after ">" is the limit at which a run was stopped without reaching the threshold. Such a run counts as slower '
        'than all others; "not reached" means that its limit is not known.'
    )
    return [Table(title, header, lines)]


def censored(results: Sequence[dict[str, Any]], name: str, form: str, unit: float = 1.0) -> str:
    """Write the median and the range of a number; runs that did not reach their targets count as the largest."""
    ordered = sorted((not one.get("reached", True), (one[name] or 0.0) / unit) for one in results)

    def text(*runs: tuple[bool, float]) -> str:
        values = [value for _, value in runs]
        missed = any(missed for missed, _ in runs)
        return "not reached" if 0.0 in values else f"{'> ' if missed else ''}{statistics.fmean(values):{form}}"

    middle = text(*ordered[(len(ordered) - 1) // 2 : len(ordered) // 2 + 1])
    return middle if len(ordered) == 1 else f"{middle} ({text(ordered[0])} to {text(ordered[-1])})"


EXPERIMENT = Experiment(
    name="records", conditions=(
        "The C engine (device cpu) or the Warp engine (device cuda), with exact physics or, until a gate, the physics "
        "that the task suggests. Gates are tested on the C engine with exact physics."
    ),
    summary="Seconds and samples from process start until a policy reaches a threshold.",
    cases=cases, estimate=lambda case: 120.0, measure=measure, tables=tables, options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
