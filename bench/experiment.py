"""Run experiments: cases, stored results, tables and figures.

An experiment is a module that defines ``EXPERIMENT``. ``main`` skips cases with stored results from the same hardware
and software. Each result is written immediately, so the same command continues an interrupted run.
"""

import concurrent.futures
import contextlib
import dataclasses
import datetime
import difflib
import importlib
import importlib.metadata
import json
import multiprocessing
import os
import queue
import shutil
import signal
import statistics
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
import tyro

from lyceum_warp.support.versions import versions

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / "results"
NAMES = (
    "throughput", "learning", "records", "gate", "mppi", "latency", "humanoid", "fidelity", "agreement", "equivalence",
    "policies", "integrators", "students", "tracking", "fits", "pictures", "objects", "soak",
)  # fmt: skip

HARDWARE = ("cpu", "cores", "gpu", "driver", "power_limit")
"""Fields of stored results. Results are compared only if these fields are equal."""

GPU_QUERY = {
    "driver": "driver_version", "power_limit": "power.limit", "clock_sm": "clocks.sm", "clock_sm_max": "clocks.max.sm",
    "clock_memory": "clocks.mem", "throttled": "clocks_event_reasons.active",
}  # fmt: skip
"""Maps each name in the stored results to a field of nvidia-smi."""

SOFTWARE = ("python", "mujoco", "mujoco_warp", "warp_lang", "torch", "numpy", "gymnasium")
"""Results are compared only if the versions of these packages are equal."""


class Skipped(Exception):  # noqa: N818
    """This machine cannot measure a case."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of every experiment; an experiment may derive a class with additional options."""

    short: bool = False
    """Run a small measurement (two minutes on two cores), and write the results to results/short/."""
    out: Path | None = None
    """File of the results (JSON lines); by default results/NAME.jsonl."""
    tasks: tuple[str, ...] = ()
    """Tasks; by default all tasks of the experiment."""
    contestants: tuple[str, ...] = ()
    """Contestants; by default all contestants of the experiment."""
    device: str = "cpu"
    """Device of the Warp engine, for example cuda."""
    threads: int | None = None
    """Threads of each contestant on the CPU; by default all cores."""
    repeats: int | None = None
    """Number of repeats of each comparison."""
    seeds: tuple[int, ...] = ()
    """Seeds. Some experiments do not use them."""
    jobs: int = 1
    """Number of cases that run at the same time, each on its own cores. Some experiments allow only one."""


@dataclasses.dataclass(frozen=True)
class Stored:
    """Options of the programs that read stored results."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of the experiments; by default all that have results."""
    results: Path = RESULTS
    """Folder with the results, to which the program writes."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One result, stored as a line of the results file."""

    case: dict[str, Any]
    result: dict[str, Any]
    provenance: dict[str, Any]
    seconds: float
    """Wall-clock time of the measurement, including setup."""


@dataclasses.dataclass(frozen=True)
class Table:
    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        return "\n".join([self.title, "", *(f"| {' | '.join(line)} |" for line in lines)])


@dataclasses.dataclass(frozen=True)
class Experiment:
    """An experiment. A case is a frozen dataclass with everything that affects the result, except machine and versions.

    Contestants take turns: the cases of the first repeat come first, then those of the second repeat, and so on.
    """

    name: str
    summary: str
    cases: Callable[[Any], Sequence[Any]]
    """Return the cases in the order of measurement."""
    estimate: Callable[[Any], float]
    """Return the expected seconds of a case on two cores."""
    measure: Callable[[Any, Any], dict[str, Any]]
    """Measure a case; raise Skipped if this machine cannot."""
    tables: Callable[[Sequence[Row]], Sequence[Table]]
    """Make tables from the stored results of one machine."""
    conditions: str
    """Engine and physics of the results, for the page of tables."""
    figure: Callable[[Sequence[Row]], Any] | None = None
    """Plot the stored results of one machine; return None if there is nothing to plot."""
    options: type[Options] = Options
    packages: tuple[str, ...] = ()
    """Other libraries whose versions are stored with the results."""
    parallel: bool = False
    """Whether cases may run in subprocesses (``--jobs``)."""
    pooled: bool = False
    """Whether the tables combine the results of all machines."""


def load(name: str) -> Experiment:
    choose((name,), NAMES, what="experiment")
    return importlib.import_module(name).EXPERIMENT


def choose(names: Sequence[str], choices: Iterable[str], default: Sequence[str] = (), *, what: str) -> tuple[str, ...]:
    """Return the given names, the default names or all known names: the first of these that is not empty."""
    choices = tuple(choices)
    for name in names:
        if name not in choices:
            close = difflib.get_close_matches(name, choices, 1)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(choices)}"
            raise ValueError(f"there is no {what} {name!r}: {hint}")
    return tuple(names) or tuple(default) or choices


def installed(module: str, requirement: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        if error.name != module.partition(".")[0]:
            raise Skipped(f"{module} cannot be imported: {error}") from error
        raise Skipped(f"{module} is not installed: pip install {requirement}") from error


# files of results


def stored(names: Sequence[str], results: Path) -> dict[str, Path]:
    paths = {name: results / f"{name}.jsonl" for name in choose(names, NAMES, what="experiment")}
    if not names:
        paths = {name: path for name, path in paths.items() if path.exists()}
    for name, path in paths.items():
        if not path.exists():
            raise FileNotFoundError(f"there is no {path}: run the experiment {name} first")
    if not paths:
        raise FileNotFoundError(f"there are no results in {results}: run an experiment first")
    return paths


def read(path: Path) -> list[Row]:
    """Read a results file; drop an incomplete last line with a warning."""
    rows, _ = _read(path)
    return rows


def _read(path: Path) -> tuple[list[Row], int]:
    rows, size = [], 0
    for number, line in enumerate(path.read_bytes().splitlines(keepends=True), start=1):
        try:
            if not line.endswith(b"\n"):
                print(f"{path}: line {number} is incomplete and is dropped", file=sys.stderr)
                break
            rows.append(Row(**json.loads(line)))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: line {number} is not a result of an experiment") from error
        size += len(line)
    return rows, size


def append(path: Path, row: Row) -> None:
    with path.open("ab") as file:
        file.write(json.dumps(dataclasses.asdict(row)).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def machine(row: Row) -> tuple[Any, ...]:
    return tuple(row.provenance.get(name) for name in HARDWARE)


def software(row: Row) -> tuple[Any, ...]:
    """Return a row's package versions."""
    return tuple(row.provenance.get(name) for name in SOFTWARE)


def by_machine(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Group the last rows of all cases by hardware and software, under names such as "64-cores-h200"."""
    groups: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        groups.setdefault((machine(row), software(row)), {})[key(row.case)] = row
    named: dict[str, list[Row]] = {}
    for same in groups.values():
        name = slug(next(iter(same.values())))
        while name in named:
            name += "-other"
        named[name] = list(same.values())
    return named


def slug(row: Row) -> str:
    cores, gpu = row.provenance["cores"], row.provenance.get("gpu")
    model = [] if gpu is None else [word.lower() for word in gpu.split() if any(map(str.isdigit, word))][:1] or ["gpu"]
    return "-".join([f"{cores}-cores", *model])


def described(rows: Sequence[Row]) -> str:
    provenance = rows[-1].provenance
    parts = [f"{provenance['cores']} cores ({provenance['cpu']})"]
    if provenance.get("gpu"):
        parts.append(f"{provenance['gpu']} (driver {provenance.get('driver')})")
    names = {"mujoco": "mujoco", "mujoco_warp": "mujoco_warp", "warp_lang": "Warp", "torch": "torch"}
    parts.append(", ".join(f"{label} {provenance.get(name)}" for name, label in names.items()))
    by_date = sorted(rows, key=lambda row: row.provenance.get("date", ""))
    commits = dict.fromkeys(commit[:7] for row in by_date if (commit := row.provenance.get("commit")))
    dates = sorted({date[:10] for row in rows if (date := row.provenance.get("date"))})
    parts.append(f"commit {', '.join(commits)}" if commits else "commit unknown")
    if dates:
        parts.append(dates[0] if len(dates) == 1 else f"{dates[0]} to {dates[-1]}")
    return "; ".join(parts)


def key(case: Mapping[str, Any]) -> str:
    """Return a string that is equal for equal cases."""
    return json.dumps(case, sort_keys=True)


# shared helpers


def grouped(rows: Sequence[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    """Group rows by the named entries of their cases."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row.case.get(name) for name in names), []).append(row)
    return groups


def paired(rows: Sequence[Row], quantity: str, unit: str) -> dict[str, list[float]]:
    """Divide each contestant's value by the value of the contestant ``unit`` in the same repeat."""
    values: dict[str, dict[int, float]] = {}
    for row in rows:
        values.setdefault(row.case["contestant"], {})[row.case["repeat"]] = row.result[quantity]
    ones = values.get(unit, {})
    return {name: [mine[i] / ones[i] for i in sorted(mine) if i in ones] for name, mine in values.items()}


def median_and_range(values: Sequence[float], form: str = ".2f") -> str:
    if not values:
        return ""
    middle = format(statistics.median(values), form)
    return middle if len(values) == 1 else f"{middle} ({min(values):{form}} to {max(values):{form}})"


@contextlib.contextmanager
def cores(number: int | None) -> Iterator[None]:
    """Run this thread on the first ``number`` cores only. Its child threads and processes inherit this limit."""
    before = sorted(os.sched_getaffinity(0))
    if number is not None and number > len(before):
        raise Skipped(f"{number} threads need {number} cores, and this process has {len(before)}")
    os.sched_setaffinity(0, before[:number])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


# the program


def duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def provenance(experiment: Experiment, device: str) -> dict[str, Any]:
    entries = versions(device)
    if (program := shutil.which("nvidia-smi")) is not None and device.startswith("cuda"):
        index = device.partition(":")[2] or "0"
        query = f"--query-gpu={','.join(GPU_QUERY.values())}"
        done = subprocess.run(
            [program, f"--id={index}", query, "--format=csv,noheader"], capture_output=True, text=True
        )
        values = [value.strip() for value in done.stdout.strip().split(",")]
        if done.returncode == 0 and len(values) == len(GPU_QUERY):
            entries |= dict(zip(GPU_QUERY, values, strict=True))
    peers = {}
    for package in experiment.packages:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            peers[package] = importlib.metadata.version(package)
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return entries | {"gpu": entries.get("gpu"), "peers": peers, "date": date}


def run(experiment: Experiment, options: Options) -> int:
    """Measure the cases that have no stored result yet, and return the exit code."""
    kind, _, number = options.device.partition(":")
    if kind not in ("cpu", "cuda") or (number and not number.isdigit()):
        raise ValueError(f"there is no device {options.device!r}: give cpu, cuda or cuda:1")
    if kind == "cuda" and int(number or 0) >= torch.cuda.device_count():
        raise ValueError(f"there is no GPU for --device {options.device}")
    cases = {key(dataclasses.asdict(case)): case for case in experiment.cases(options)}
    folder = RESULTS / "short" if options.short else RESULTS
    path = options.out or folder / f"{experiment.name}.jsonl"
    rows, size = _read(path) if path.exists() else ([], 0)
    now = Row({}, {}, provenance(experiment, options.device), 0.0)
    stored_cases = {key(row.case) for row in rows if machine(row) == machine(now) and software(row) == software(now)}
    left = {name: case for name, case in cases.items() if name not in stored_cases}
    took = duration(sum(map(experiment.estimate, left.values())) / max(1, options.jobs))
    print(f"{experiment.name}: {len(cases) - len(left)} of {len(cases)} cases are stored; the rest takes about {took}")
    if options.jobs != 1 and not experiment.parallel:
        raise ValueError(f"the cases of {experiment.name} compete for the cores: jobs must be 1")
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        os.truncate(path, size)
    skipped: set[str] = set()
    failed = 0
    for number, (case, result, seconds) in enumerate(outcomes(experiment, list(left.values()), options), start=1):
        if isinstance(result, Skipped):
            if str(result) not in skipped:
                print(f"skipped: {result}", flush=True)
            skipped.add(str(result))
            continue
        if isinstance(result, Exception):  # a failed case does not stop the remaining cases
            failed += 1
            traceback.print_exception(result)
            print(f"failed: {_text(case)}", file=sys.stderr, flush=True)
            continue
        row = Row(dataclasses.asdict(case), result, provenance(experiment, options.device), seconds)
        append(path, row)
        print(f"[{number}/{len(left)}] {_text(case)}: {_values(result)}", flush=True)
    mine = [row for row in (read(path) if path.exists() else []) if machine(row) == machine(now)]
    for here in list(by_machine(mine).values())[-1:]:
        for table in experiment.tables(here):
            print("\n" + table.markdown())
        print(f"\nresults: {path}; lyceum-warp bench plot {experiment.name} draws them")
    return 1 if failed else 0


def outcomes(
    experiment: Experiment, cases: Sequence[Any], options: Options
) -> Iterator[tuple[Any, dict[str, Any] | Exception, float]]:
    if options.jobs == 1:
        for case in cases:
            began = time.perf_counter()
            try:
                result: dict[str, Any] | Exception = experiment.measure(case, options)
            except Exception as error:
                result = error
            yield case, result, time.perf_counter() - began
        return
    places = queue.SimpleQueue[set[int]]()
    for place in core_sets(options.jobs, options.threads):
        places.put(place)
    context = multiprocessing.get_context("spawn")

    def alone(case: Any) -> tuple[Any, dict[str, Any] | Exception, float]:
        began, place = time.perf_counter(), places.get()
        os.sched_setaffinity(0, place)  # the subprocess inherits this thread's CPU affinity
        try:
            with concurrent.futures.ProcessPoolExecutor(1, context) as process:
                result = process.submit(_measure_apart, experiment.measure, case, options).result()
        except Exception as error:  # the case failed, or the process of the case died
            result = error
        places.put(place)
        return case, result, time.perf_counter() - began

    threads = concurrent.futures.ThreadPoolExecutor(options.jobs)
    try:
        for future in concurrent.futures.as_completed([threads.submit(alone, case) for case in cases]):
            yield future.result()
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()
        threads.shutdown()


def _measure_apart(measure: Callable[[Any, Any], Any], case: Any, options: Options) -> Any:
    """Measure a case in this subprocess, which ends on SIGTERM or with its parent."""
    # let SIGTERM raise KeyboardInterrupt, so that the subprocesses of the case also end
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    threading.Thread(target=_interrupt_after_parent, daemon=True).start()
    return measure(case, options)


def _interrupt_after_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(5.0)  # the pool may catch the interrupt, and wait for work of a parent that is gone
    os._exit(1)


def core_sets(jobs: int, threads: int | None) -> list[set[int]]:
    usable = sorted(os.sched_getaffinity(0))
    each = threads or len(usable) // max(1, jobs)
    if jobs < 1 or each < 1 or jobs * each > len(usable):
        raise ValueError(f"{jobs} jobs with {each} threads need {jobs * each} cores, and there are {len(usable)}")
    return [set(usable[job * each : (job + 1) * each]) for job in range(jobs)]


def _text(case: Any) -> str:
    return " ".join(f"{name}={value}" for name, value in dataclasses.asdict(case).items())


def _values(result: Mapping[str, Any]) -> str:
    numbers = {name: value for name, value in result.items() if isinstance(value, (int, float, str))}
    return ", ".join(f"{name} {value:,.5g}" if isinstance(value, float) else f"{name} {value}"
                     for name, value in numbers.items())  # fmt: skip


def main(experiment: Experiment, argv: Sequence[str] | None = None) -> int:
    """Run an experiment and return its exit code: 1 if a case failed, 2 for bad input, 130 after Ctrl-C, else 0."""
    prog, description = f"lyceum-warp bench {experiment.name}", experiment.summary
    options = tyro.cli(experiment.options, prog=prog, description=description, args=argv)
    return guarded(lambda: run(experiment, options), experiment.name)


def guarded(program: Callable[[], int], name: str) -> int:
    """Run a program; report bad input and Ctrl-C in one line."""
    try:
        return program()
    except (ValueError, FileNotFoundError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\n{name}: stopped; repeat the command to continue", file=sys.stderr)
        return 130
