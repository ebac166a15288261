"""Measure how many clips a tracking policy fails as training goes on, in minutes from process start.

    lyceum-warp bench tracking --clips MOTIONS --device cuda --seeds 0 1 2
    lyceum-warp bench tracking --clips walk.npz --minutes 15 --seeds 0 1 2
    lyceum-warp bench tracking --clips MOTIONS --device cuda --sampling adaptive uniform

The clock starts before ``lyceum-warp train``, so that the minutes include imports, compilation and graph captures. With
a warm cache, one iteration of the same command fills the cache of kernels first. Training keeps numbered policies. When
it has ended, those that were saved last before each mark are judged: every clip once from its first frame, without
noise, on the C engine under exact physics (``lw.evaluate_clips``). A run that lasts longer than --seconds is stopped.
The same command continues it, and the clock goes on from there.
"""

import contextlib
import dataclasses
import json
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import experiment
import records
import torch
from experiment import Experiment, Row, Skipped, Table

import lyceum_warp as lw
from lyceum_warp.cli.evaluate import run_worlds
from lyceum_warp.engines import options_on_cores

MARKS = (
    0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0
)  # fmt: skip
"""Minutes from process start at which policies are judged."""

SAMPLING = {"adaptive": (), "uniform": ("--param", "failure_weight=0")}

FLAGS = {
    "cpu": "--nworld 128 --num-steps 32 --hidden 256 128 --value-hidden 256 128 --discardvisual --symmetry exact "
    "--desired-kl 0.1 --log-std -1.5 --entropy-coef 0.001 --param randomness=0.3 --threads 2",
    "cuda": "",
}
"""Flags of `lyceum-warp train`, by device."""


@dataclasses.dataclass(frozen=True)
class Options(experiment.Options):
    clips: tuple[Path, ...] = ()
    """Files and folders of motions; by default the task's own clips. The results hold only the names of the clips."""
    sampling: tuple[Literal["adaptive", "uniform"], ...] = ("adaptive",)
    """Where episodes begin."""
    minutes: float = 20.0
    """Minutes from process start."""
    flags: str | None = None
    """Flags of `lyceum-warp train`, as --flags="--nworld 64"."""
    seconds: float = 540.0
    """Seconds after which a run is stopped; the same command continues the run."""
    keep_every: int = 10
    """Iterations between kept policies."""
    cache: Literal["warm", "cold"] = "warm"
    """State of the cache of compiled kernels."""
    runs: Path = Path("runs/tracking")
    """Folder in which the runs are stored."""


@dataclasses.dataclass(frozen=True)
class Case:
    task: str
    clips: str
    sampling: str
    minutes: float
    seed: int
    device: str
    cache: str
    flags: str


def cases(options: Options) -> list[Case]:
    kind = options.device.partition(":")[0]
    flags = FLAGS[kind] if options.flags is None else options.flags
    names = " ".join(path.name for path in options.clips) or "the task's"
    minutes = 1.0 if options.short else options.minutes
    return [
        Case(task, names, sampling, minutes, seed, kind, options.cache, flags)
        for task in options.tasks or ("g1_tracking",) for seed in options.seeds or (0,)
        for sampling in options.sampling
    ]  # fmt: skip


def command(case: Case, options: Options, folder: Path) -> list[str]:
    train = [sys.executable, "-m", "lyceum_warp.cli", "train"]
    if (folder / "checkpoint.pt").exists():
        return [*train, "--resume", str(folder), *records.COMMON]
    clips = ["--clips", *map(str, options.clips)] if options.clips else []
    return [
        *train, case.task, *clips, *SAMPLING[case.sampling], *case.flags.split(), "--device", options.device,
        "--seed", str(case.seed), "--keep-every", str(options.keep_every), "--mean-every", "0", "--out", str(folder),
        *records.COMMON,
    ]  # fmt: skip


def measure(case: Case, options: Options) -> dict[str, Any]:
    """Train for some minutes, then judge policies; raise Skipped after the time limit of this call."""
    name = f"{case.task}-{case.device}-{case.cache}-{case.sampling}-{case.seed}"
    folder, notes = options.runs / name, options.runs / f"{name}.json"
    done = json.loads(notes.read_text()) if notes.exists() and (folder / "checkpoint.pt").exists() else []
    if not done:
        shutil.rmtree(folder, ignore_errors=True)
    options.runs.mkdir(parents=True, exist_ok=True)
    total = sum(end - start for start, end in done)
    if total < 60.0 * case.minutes - 1.0:
        with environment(case, options, folder) as variables:
            start = time.time()
            process = records.run(command(case, options, folder), variables)
            limit = min(options.seconds, 60.0 * case.minutes - total)
            while process.poll() is None and time.time() - start < limit:
                time.sleep(0.1)
            if process.poll() is not None:
                raise RuntimeError(f"training ended with code {process.returncode} after {time.time() - start:.0f} s")
            end = time.time()
            process.send_signal(signal.SIGTERM)  # the process saves the run after the current iteration
            process.wait()
        notes.write_text(json.dumps([*done, [start, end]]))
        if total + end - start < 60.0 * case.minutes - 1.0:
            raise Skipped(f"{name} has learned for {total + end - start:.0f} s: repeat the command to continue")
        done = [*done, [start, end]]
    torch.set_num_threads(1)
    run = lw.Run.open(folder)
    env = run_worlds(run, {**options_on_cores(), "physics": "exact"}, {}, nworld=1)
    rows = {row["iteration"]: row for row in run.rows()}
    results = []
    for mark, file in policies(run, done, case.minutes):
        iteration = int(file.stem)
        clips = lw.evaluate_clips(env, lw.load(run, which=iteration))
        results.append({
            "minutes": mark, "iteration": iteration, "samples": rows[iteration]["samples"], "failures": clips.failures,
            "score": clips.scores.mean().item(), "return": clips.returns.mean().item(), **clips.to_dict(),
        })  # fmt: skip
    learning = sum(row[part] or 0.0 for row in run.rows() for part in row if part.startswith("time_"))
    return {
        "clips": len(env.task.params["ranges"]), "starts": len(done), "learning_seconds": learning, "policies": results,
    }  # fmt: skip


@contextlib.contextmanager
def environment(case: Case, options: Options, folder: Path) -> Iterator[dict[str, str]]:
    """Return the variables of a process whose cache of kernels is empty, or was filled by one iteration."""
    with tempfile.TemporaryDirectory() as spare:
        if case.cache == "cold":
            names = ("WARP_CACHE_PATH", "CUDA_CACHE_PATH", "TORCHINDUCTOR_CACHE_DIR")
            yield os.environ | {name: f"{spare}/{name}" for name in names}
            return
        if not list(options.runs.glob(f"{case.task}-{case.device}-{case.cache}-*/")):
            once = command(case, options, Path(spare) / "run")
            once[once.index("--iterations") + 1] = "1"
            records.run(once, dict(os.environ)).wait()
        yield dict(os.environ)


def policies(run: lw.Run, done: Sequence[Sequence[float]], minutes: float) -> Iterator[tuple[float, Path]]:
    """Yield each mark and the last policy that was saved before it. The clock runs only while the command runs."""
    files = sorted((file.stat().st_mtime, file) for file in (run.folder / "policies").glob("*.pt"))
    for mark in [*(mark for mark in MARKS if mark < minutes), minutes]:
        left, wall = 60.0 * mark, done[-1][1] + 60.0
        for start, end in done:
            if left <= end - start:
                wall = start + left
                break
            left -= end - start
        if saved := [file for at, file in files if at <= wall]:
            yield mark, saved[-1]


def tables(rows: Sequence[Row]) -> list[Table]:
    tables = []
    names = ("task", "clips", "device", "cache", "flags")
    for (task, clips, device, _, flags), same in experiment.grouped(rows, *names).items():
        marks = sorted({one["minutes"] for row in same for one in row.result["policies"]})
        lines = []
        for (sampling, seed), several in sorted(experiment.grouped(same, "sampling", "seed").items()):
            row = max(several, key=lambda row: row.case["minutes"])
            policies = {one["minutes"]: one for one in row.result["policies"]}
            *_, last = policies.values()
            lines.append([
                sampling, str(seed), *(str(policies[mark]["failures"]) if mark in policies else "" for mark in marks),
                f"{last['samples'] / 1e6:.3g}", f"{last['score']:.3f}", f"{last['return']:.1f}",
                *(f"{1000 * sum(last[name]) / len(last[name]):.0f}" for name in ("mpkpe", "r_mpkpe")),
            ])  # fmt: skip
        title = (
            f"{task} on {device}, clips {clips}{f', `{flags}`' if flags else ''}: how many of {same[0].result['clips']}"
            " clips fail on the C engine by minutes from process start; samples, score, return and errors of the last "
            "policy."
        )
        header = [
            "starts", "seed", *(f"{mark:g}" for mark in marks), "million samples", "score", "return", "MPKPE, mm",
            "R-MPKPE, mm",
        ]  # fmt: skip
        tables.append(Table(title, header, lines))
    return tables


def figure(rows: Sequence[Row]) -> Any:
    """Plot failures against minutes, a line for each seed."""
    from lyceum_warp.viz import STYLES, finish_axes, new_figure

    plot = new_figure("failures of clips", 6.0, 4.0)
    axes = plot.subplots()
    styles = dict(zip(SAMPLING, STYLES, strict=False))
    for row in rows:
        colour, marker, line = styles[row.case["sampling"]]
        points = [(one["minutes"], one["failures"]) for one in row.result["policies"]]
        axes.plot(*zip(*points, strict=True), color=colour, marker=marker, linestyle=line, alpha=0.7)
    for sampling in {row.case["sampling"] for row in rows}:
        axes.plot([], [], color=styles[sampling][0], marker=styles[sampling][1], label=sampling)
    axes.set(xlabel="minutes from process start", ylabel=f"failed clips of {rows[0].result['clips']}", xscale="log")
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False)
    finish_axes([axes])
    return plot


EXPERIMENT = Experiment(
    name="tracking", conditions="Training in the task's suggested physics; clips on the C engine with exact physics.",
    summary="How many clips a tracking policy fails after some minutes of training.",
    cases=cases, estimate=lambda case: 60.0 * case.minutes, measure=measure, tables=tables, figure=figure,
    options=Options,
)  # fmt: skip

if __name__ == "__main__":
    sys.exit(experiment.main(EXPERIMENT))
