"""What the experiments of this folder share: command line, cases, results as JSON lines, tables and figures.

An experiment is one file with an ``EXPERIMENT``: a list of cases, a function that measures one of them, and functions
that make tables and a figure from results alone. ``main`` prints the time that the cases take, leaves out those that
the file of results has from the same hardware and versions, and writes each result when it is there, so that a
program that is killed loses one case at most. The same command then continues.
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
import signal
import statistics
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import measurements
import torch
import tyro

FOLDER = Path(__file__).resolve().parent
RESULTS = FOLDER / "results"
NAMES = ("throughput", "scaling", "npg", "mppi", "fidelity", "latency")
"""The experiments, in the order of the lists."""

SOFTWARE = ("python", "lyceum_warp", "mujoco", "mujoco_warp", "warp_lang", "torch", "numpy", "gymnasium")
"""Entries that, with the hardware's, must be equal for a result to stand for a case that is to be measured."""


class Skipped(Exception):  # noqa: N818
    """A case cannot be measured here, as its peer is not installed; the text is one line that says why."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of all experiments. An experiment may derive a class with more of them."""

    short: bool = False
    """Measure so little that two cores finish in two minutes; the results go into results/short/."""
    out: Path | None = None
    """File of the results (JSON lines); by default results/NAME.jsonl beside this program."""
    tasks: tuple[str, ...] = ()
    """Tasks; by default all of the experiment's."""
    contestants: tuple[str, ...] = ()
    """What is compared; by default all of the experiment's."""
    device: str = "cpu"
    """Device of the Warp engine, for example cuda."""
    threads: int | None = None
    """Threads of everything that runs on the CPU; by default all cores."""
    repeats: int | None = None
    """How often every comparison is repeated."""
    seeds: tuple[int, ...] = ()
    """Seeds, where the experiment has some."""
    jobs: int = 1
    """Cases at the same time, each on as many cores of its own as there are threads, where the experiment allows it."""
    dry_run: bool = False
    """Print the cases and their time, and measure nothing."""


@dataclasses.dataclass(frozen=True)
class Row:
    """One result, a line of the file."""

    case: dict[str, Any]
    """What was measured."""
    result: dict[str, Any]
    provenance: dict[str, Any]
    """Machine, versions, commit and date."""
    seconds: float
    """Wall-clock time of the measurement, with its preparation."""


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of text."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        lines = [self.header, ["---"] * len(self.header), *self.rows]
        return "\n".join([*([self.title, ""] if self.title else []), *(f"| {' | '.join(line)} |" for line in lines)])


@dataclasses.dataclass(frozen=True)
class Experiment:
    """An experiment, as its file defines it.

    A case is a frozen dataclass of the experiment's own, with everything that the result depends on except for machine
    and versions: sizes, number of the repeat, seed, whether it is the short mode's. Where contestants are compared,
    they must take turns: list the cases with the repeats outside and the contestants inside.
    """

    name: str
    """Name of the program and of the file of results."""
    summary: str
    """One line."""
    cases: Callable[[Any], Sequence[Any]]
    """Cases for the options, in the order of the measurements."""
    estimate: Callable[[Any], float]
    """Seconds that a case takes on two cores."""
    measure: Callable[[Any, Any], dict[str, Any]]
    """Measures a case with the options; raises Skipped where that is impossible here."""
    tables: Callable[[Sequence[Row]], Sequence[Table]]
    """Tables from the results of one machine alone."""
    figure: Callable[[Sequence[Row]], Any] | None
    """Figure of matplotlib, which may be missing where cases are measured, from the results of one machine alone.

    None where they hold nothing to draw.
    """
    options: type[Options] = Options
    packages: tuple[str, ...] = ()
    """Peers whose versions belong to the provenance."""
    apart: bool = False
    """Whether each case is a process of its own, on cores of its own, so that several can run at the same time."""
    parallel: bool = False
    """Whether the same holds where several run at the same time, and only then."""


def load(name: str) -> Experiment:
    """An experiment by its name.

    Raises:
        ValueError: There is none of that name.
    """
    choose((name,), NAMES, what="experiment")
    return importlib.import_module(name).EXPERIMENT


def choose(given: Sequence[str], known: Iterable[str], default: Sequence[str] = (), *, what: str) -> tuple[str, ...]:
    """The names that were given, or the default ones where there are none; all, where there is no default.

    Raises:
        ValueError: A name is unknown.
    """
    known = tuple(known)
    for name in given:
        if name not in known:
            close = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"
            raise ValueError(f"there is no {what} {name!r}: {hint}")
    return tuple(given) or tuple(default) or known


def installed(module: str, requirement: str) -> Any:
    """Import a peer that shares our environment.

    Raises:
        Skipped: It is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        if error.name != module.partition(".")[0]:
            raise Skipped(f"{module} cannot be imported: {error}") from error
        raise Skipped(f"{module} is not installed: pip install {requirement}") from error


# files of results


def read(path: Path) -> list[Row]:
    """Rows of a file of results; a last line that was torn off is left out, with a warning.

    Raises:
        ValueError: A line is not a result.
    """
    rows, _ = _read(path)
    return rows


def _read(path: Path) -> tuple[list[Row], int]:
    """Rows, and the number of bytes up to the end of the last one."""
    rows, size = [], 0
    for number, line in enumerate(path.read_bytes().splitlines(keepends=True), start=1):
        try:
            if not line.endswith(b"\n"):
                print(f"{path}: line {number} was torn off by a stop, and is left out", file=sys.stderr)
                break
            rows.append(Row(**json.loads(line)))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path}: line {number} is not a result of an experiment") from error
        size += len(line)
    return rows, size


def append(path: Path, row: Row) -> None:
    """Add a row to a file of results; it has reached the disk when this returns."""
    with path.open("ab") as file:
        file.write(json.dumps(dataclasses.asdict(row)).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def machine(row: Row) -> tuple[Any, ...]:
    """What must be equal for numbers to be compared."""
    return tuple(row.provenance.get(name) for name in measurements.HARDWARE)


Software = tuple[tuple[Any, ...], frozenset[tuple[str, str]]]
"""Versions of SOFTWARE, and those of the peers that are installed."""


def _software(row: Row) -> Software:
    peers = row.provenance.get("peers") or {}
    return tuple(row.provenance.get(name) for name in SOFTWARE), frozenset(peers.items())


def _agree(one: Software, other: Software) -> bool:
    """Whether the versions are the same; a peer that is missing on one side took no part there."""
    mine, theirs = dict(one[1]), dict(other[1])
    return one[0] == other[0] and all(mine[name] == theirs[name] for name in mine.keys() & theirs.keys())


def by_machine(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows of each machine under a short name of it, such as "64-cores-h200".

    Of each case it takes the last row. It leaves out rows whose versions differ from those of a later row that stays.
    """
    machines: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        machines.setdefault(machine(row), []).append(row)
    named: dict[str, list[Row]] = {}
    for same in machines.values():
        accepted: dict[Software, bool] = {}
        for software in map(_software, reversed(same)):
            if software not in accepted:
                accepted[software] = all(_agree(software, later) for later, kept in accepted.items() if kept)
        latest = {key(row.case): row for row in same if accepted[_software(row)]}
        name = slug(same[-1])
        while name in named:
            name += "-other"
        named[name] = list(latest.values())
    return named


def slug(row: Row) -> str:
    """Short name of a machine."""
    cores, gpu = row.provenance["cores"], row.provenance.get("gpu")
    model = [] if gpu is None else [word.lower() for word in gpu.split() if any(map(str.isdigit, word))][:1] or ["gpu"]
    return "-".join([f"{cores}-cores", *model])


def described(row: Row) -> str:
    """The machine and the versions, in one line."""
    found = row.provenance
    parts = [f"{found['cores']} cores ({found['cpu']})"]
    if found.get("gpu"):
        parts.append(f"{found['gpu']} (driver {found.get('driver')})")
    names = {"mujoco": "mujoco", "mujoco_warp": "mujoco_warp", "warp_lang": "Warp", "torch": "torch"}
    parts.append(", ".join(f"{label} {found.get(name)}" for name, label in names.items()))
    commit = [f"commit {found['commit'][:10]}"] if found.get("commit") else []
    parts.append(", ".join([*commit, found["date"][:10]]))
    return "; ".join(parts)


def key(case: Mapping[str, Any]) -> str:
    """A case as text that is equal for equal cases."""
    return json.dumps(case, sort_keys=True)


# statistics that several experiments use


def paired(rows: Sequence[Row], quantity: str, unit: str, by: str = "contestant") -> dict[str, list[float]]:
    """Ratios of a quantity to the unit's, for each contestant, from the same repeats.

    Args:
        rows: Rows of otherwise equal cases, which have a ``repeat``.
        quantity: Entry of the results.
        unit: The contestant that counts as 1.
        by: Entry of the cases that names the contestant.
    """
    values: dict[str, dict[int, float]] = {}
    for row in rows:
        values.setdefault(row.case[by], {})[row.case["repeat"]] = row.result[quantity]
    ones = values.get(unit, {})
    return {name: [mine[i] / ones[i] for i in sorted(mine) if i in ones] for name, mine in values.items()}


def median_and_range(values: Sequence[float], form: str = ".2f") -> str:
    """Median, and the smallest and largest value in parentheses; empty text without values."""
    if not values:
        return ""
    middle = format(statistics.median(values), form)
    return middle if len(values) == 1 else f"{middle} ({min(values):{form}} to {max(values):{form}})"


@contextlib.contextmanager
def cores(number: int | None) -> Iterator[None]:
    """Let this thread, and the threads and processes that it starts, use only the first of its cores.

    Raises:
        Skipped: There are fewer.
    """
    before = sorted(os.sched_getaffinity(0))
    if number is not None and number > len(before):
        raise Skipped(f"{number} threads need as many cores, and {len(before)} are here")
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
    found = measurements.context(device)
    peers = {}
    for package in experiment.packages:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            peers[package] = importlib.metadata.version(package)
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return found | {"gpu": found.get("gpu"), "peers": peers, "date": date}


def run(experiment: Experiment, options: Options) -> int:
    """Measure the cases that the file of results does not have; returns the exit code.

    Raises:
        ValueError: An option is wrong.
    """
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
    known = {key(row.case) for row in rows if machine(row) == machine(now) and _agree(_software(row), _software(now))}
    left = {name: case for name, case in cases.items() if name not in known}
    took = duration(sum(map(experiment.estimate, left.values())) / max(1, options.jobs))
    print(f"{experiment.name}: {len(cases) - len(left)} of {len(cases)} cases are there; the rest takes about {took}")
    if options.jobs != 1 and not (experiment.apart or experiment.parallel):
        raise ValueError(f"the cases of {experiment.name} compete for the cores, so that jobs must be 1")
    if options.dry_run:
        for case in left.values():
            print(f"  {_text(case)}: {duration(experiment.estimate(case))}")
        return 0
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
        if isinstance(result, Exception):  # the other cases are worth measuring
            failed += 1
            traceback.print_exception(result)
            print(f"failed: {_text(case)}", file=sys.stderr, flush=True)
            continue
        row = Row(dataclasses.asdict(case), result, provenance(experiment, options.device), seconds)
        append(path, row)
        print(f"[{number}/{len(left)}] {_text(case)}: {_values(result)}", flush=True)
    here = (
        [same for same in by_machine(read(path)).values() if machine(same[0]) == machine(now)] if path.exists() else []
    )
    for table in experiment.tables(here[0]) if here else []:
        print("\n" + table.markdown())
    if here:
        print(f"\nresults: {path}; lyceum-warp bench plot {experiment.name} draws them")
    return 1 if failed else 0


def outcomes(
    experiment: Experiment, cases: Sequence[Any], options: Options
) -> Iterator[tuple[Any, dict[str, Any] | Exception, float]]:
    """Cases with their results, or the exceptions that they ended with, and the seconds that they took."""
    if not experiment.apart and options.jobs == 1:
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

    running: set[Any] = set()

    def alone(case: Any) -> tuple[Any, dict[str, Any] | Exception, float]:
        began, place = time.perf_counter(), places.get()
        os.sched_setaffinity(0, place)  # of this thread, from which the process inherits it
        context = multiprocessing.get_context("spawn")
        pipe, other = context.Pipe()
        process = context.Process(target=_measure_apart, args=(other, experiment.measure, case, options))
        process.start()
        running.add(process)
        other.close()
        try:
            result = pipe.recv()
        except EOFError:
            process.join()
            result = RuntimeError(f"the process of the case ended with exit code {process.exitcode}")
        process.join()
        running.discard(process)
        places.put(place)
        return case, result, time.perf_counter() - began

    threads = concurrent.futures.ThreadPoolExecutor(options.jobs)
    try:
        for future in concurrent.futures.as_completed([threads.submit(alone, case) for case in cases]):
            yield future.result()
    finally:
        threads.shutdown(wait=False, cancel_futures=True)
        for process in list(running):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGTERM)
        threads.shutdown()


def _measure_apart(pipe: Connection, measure: Callable[[Any, Any], Any], case: Any, options: Options) -> None:
    """A case's process: sends its result, or the exception that it ended with; it ends with the program."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C, which the shell can make a program ignore
    threading.Thread(target=_interrupt_after_parent, daemon=True).start()
    try:
        result = measure(case, options)
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        error.add_note("".join(traceback.format_tb(error.__traceback__)))
        result = error
    try:
        pipe.send(result)
    except Exception as error:  # of a result that cannot be pickled
        pipe.send(RuntimeError(f"the result cannot be sent: {error!r}; it is {result!r}"))


def _interrupt_after_parent() -> None:
    """Interrupt this process when the program that started it has ended, so that it ends its own processes, too."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)


def core_sets(jobs: int, threads: int | None) -> list[set[int]]:
    """Disjoint sets of cores, one for each job; cores that share their hardware come last.

    Raises:
        ValueError: There are too few cores.
    """
    usable = sorted(os.sched_getaffinity(0), key=lambda core: (_siblings(core).index(core), core))
    each = threads or len(usable) // max(1, jobs)
    if jobs < 1 or each < 1 or jobs * each > len(usable):
        raise ValueError(f"{jobs} jobs with {each} threads need as many cores, and {len(usable)} are here")
    return [set(usable[job * each : (job + 1) * each]) for job in range(jobs)]


def _siblings(core: int) -> list[int]:
    """The logical cores that share a core's hardware, itself included."""
    try:
        text = Path(f"/sys/devices/system/cpu/cpu{core}/topology/thread_siblings_list").read_text()
        found = [range(int(part.split("-")[0]), int(part.split("-")[-1]) + 1) for part in text.strip().split(",")]
        return [sibling for part in found for sibling in part]
    except (OSError, ValueError):
        return [core]


def _text(case: Any) -> str:
    return " ".join(f"{name}={value}" for name, value in dataclasses.asdict(case).items())


def _values(result: Mapping[str, Any]) -> str:
    numbers = {name: value for name, value in result.items() if isinstance(value, (int, float, str))}
    return ", ".join(f"{name} {value:,.5g}" if isinstance(value, float) else f"{name} {value}"
                     for name, value in numbers.items())  # fmt: skip


def main(experiment: Experiment, argv: Sequence[str] | None = None) -> int:
    """The program of an experiment; returns the exit code: 0, 1 if a case failed, 2 for bad input, 130 after Ctrl-C."""
    options = tyro.cli(experiment.options, prog=f"lyceum-warp bench {experiment.name}", args=argv)
    return guarded(lambda: run(experiment, options), experiment.name)


def guarded(program: Callable[[], int], name: str) -> int:
    """Run a program, with one line for bad input and for Ctrl-C; returns the exit code."""
    try:
        return program()
    except (ValueError, FileNotFoundError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\n{name}: stopped; the same command continues", file=sys.stderr)
        return 130
