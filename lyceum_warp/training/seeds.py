"""Train a task with several seeds, each in a process of its own."""

import contextlib
import ctypes
import dataclasses
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lyceum_warp.support.interrupts import postponed
from lyceum_warp.support.validate import whole_number


@dataclasses.dataclass
class SeedRun:
    """The run of one seed."""

    seed: int
    folder: Path
    """The run's folder. The output of its process is in the file of the same name with the suffix ``.log``."""
    state: str = "waiting"
    """"waiting", "training", "complete", "stopped" or "failed"."""
    error: str = ""
    """The last line of a failed run's output, or the exception that ended it."""


def train_seeds(
    task: str | Path,
    folder: str | Path,
    seeds: int | Sequence[int] = 5,
    *,
    jobs: int = 1,
    watch: Callable[[Sequence[SeedRun]], object] = lambda runs: None,
    **settings: Any,
) -> list[SeedRun]:
    """Train a task with several seeds, as ``lyceum-warp train TASK --seeds 5`` does.

    Each seed is a run of its own in ``folder``, such as ``seed-0``, and a process of its own. The numbers are those of
    ``lyceum-warp train`` with this seed. A run that fails does not end the others. If the call is interrupted or
    killed, the same call continues all runs; a run that is complete stays as it is. After Ctrl-C or SIGTERM, all runs
    finish their iterations and are saved.

    Example:
        >>> runs = lw.train_seeds("hopper", "runs/five", seeds=5, jobs=2, iterations=60, hidden=(32, 32))

    Args:
        task: A task's name or file.
        folder: The folder of the runs.
        seeds: The number of seeds, counted from 0, or the seeds themselves.
        jobs: Number of runs that train at the same time. Each has its share of the CPU cores, and, with
            ``device="cuda"``, the next GPU in turn.
        watch: Called about five times a second with all runs. An exception that it raises ends the call, after all
            runs have finished their iterations and are saved.
        settings: Options of ``lyceum-warp train``, such as ``iterations=60`` for ``--iterations 60``. A dict gives
            several values by name: ``param={"ctrl_cost_weight": 0.05}``.

    Raises:
        ValueError: An argument is out of range, or is refused by the first run. Nothing is written then.
    """
    numbers = range(whole_number("seeds", seeds, low=1, high=1000)) if isinstance(seeds, int) else sorted(set(seeds))
    runs = [SeedRun(seed, Path(folder, f"seed-{whole_number('a seed', seed, low=0)}")) for seed in numbers]
    arguments = [str(task), *flag_words(settings)]
    places = list(_places(min(whole_number("jobs", jobs, low=1), len(runs)), settings.get("device")))
    Path(folder).mkdir(parents=True, exist_ok=True)
    waiting, active = [*runs], dict[int, tuple[SeedRun, subprocess.Popen[bytes]]]()
    with postponed() as signals, contextlib.ExitStack() as started:
        while active or (waiting and not signals):
            # until a run has begun, it trains alone: what one run refuses, all others would refuse, too
            alone = active and not _begun(runs)
            if waiting and not signals and not alone and len(active) < len(places):
                slot = min(set(range(len(places))) - active.keys())
                active[slot] = waiting[0], _start(waiting.pop(0), arguments, *places[slot])
                started.callback(active[slot][1].wait)
                started.callback(active[slot][1].terminate)
            time.sleep(0.2)
            for slot, (run, process) in list(active.items()):
                if process.poll() is not None:
                    del active[slot]
                    _conclude(run, process.returncode, refused=process.returncode == 2 and not _begun(runs))
                elif signals and run.state == "training":
                    process.terminate()
                    run.state = "stopped"
                elif len(signals) > 1:
                    process.kill()
            watch(runs)
    return runs


def flag_words(settings: Mapping[str, Any]) -> list[str]:
    """Convert options to words of the command line, such as ``hidden=(8, 8)`` to ``--hidden 8 8``."""
    flags = []
    for name, value in settings.items():
        flag = f"--{name.replace('_', '-')}"
        if isinstance(value, bool):
            flags.append(flag if value else f"--no-{flag[2:]}")
            continue
        if isinstance(value, Mapping):
            value = [f"{key}={','.join(map(str, _parts(part)))}" for key, part in value.items()]
        parts = _parts(value)
        if any(isinstance(part, str) for part in parts):  # the flag may be repeated
            flags += [word for part in parts for word in (flag, str(part))]
        else:
            flags += [flag, *map(str, parts)]
    return flags


def _parts(value: Any) -> Sequence[Any]:
    return value if isinstance(value, tuple | list) else [value]


def _places(jobs: int, device: str | None) -> Iterator[tuple[list[int], dict[str, str]]]:
    """Distribute the CPU cores and the GPUs: the cores of each job, and its environment."""
    cores = sorted(os.sched_getaffinity(0))
    gpus: Sequence[object] = ()
    if device == "cuda":
        import torch

        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        gpus = visible.split(",") if visible else range(torch.cuda.device_count())
    for slot in range(jobs):
        environment = {"CUDA_VISIBLE_DEVICES": str(gpus[slot % len(gpus)])} if gpus else {}
        yield cores[slot::jobs] or cores, os.environ | environment


def _start(
    run: SeedRun, words: Sequence[str], cores: Sequence[int], environment: Mapping[str, str]
) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "lyceum_warp.cli", "train", *words, "--seed", str(run.seed)]
    libc = ctypes.CDLL(None)

    def prepare() -> None:
        os.sched_setaffinity(0, cores)
        libc.prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG: the run is saved if this process is killed

    run.state = "training"
    with run.folder.with_suffix(".log").open("ab") as log:
        # in a session of its own, because Ctrl-C must reach the run once
        return subprocess.Popen(
            [*command, "--continue", "--out", str(run.folder)], stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            env=environment, start_new_session=True, preexec_fn=prepare,
        )  # fmt: skip


def _begun(runs: Sequence[SeedRun]) -> bool:
    return any((run.folder / "checkpoint.pt").exists() for run in runs)


def _conclude(run: SeedRun, code: int, *, refused: bool) -> None:
    """Note how a run has ended."""
    if code == 0:
        run.state = "complete"
    elif run.state == "training":
        run.state = "failed"
        log = run.folder.with_suffix(".log")
        lines = log.read_text(errors="replace").strip().splitlines() or [f"exit code {code}"]
        run.error = lines[-1].removeprefix("lyceum-warp: ")
        _, mark, trace = "\n".join(["", *lines]).rpartition("\nTraceback")
        if code == 1 and mark and run.error == lines[-1]:  # the exception's notes are the last lines
            run.error = next((line for line in trace.splitlines()[1:] if not line.startswith(" ")), run.error)
        if refused:  # this line says everything
            log.unlink()
            if not any(log.parent.iterdir()):
                log.parent.rmdir()
            raise ValueError(run.error)
