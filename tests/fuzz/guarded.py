"""Run attacks in a child process, each within limits of time and memory, and collect what went wrong.

A program of attacks calls ``serve``; a test calls ``attacks``. By hand, ``python tests/fuzz/PROGRAM.py CASE ...``
repeats cases and prints their tracebacks; it makes its files in the current folder.
"""

import contextlib
import dataclasses
import gc
import json
import os
import resource
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

MEMORY = 512 * 2**20
"""Bytes of address space that a case may add to those after the warm-up."""
PATIENCE = 3.0
"""Seconds after which a case is interrupted as by Ctrl-C, again and again. A command must end then."""
LIMIT = 60.0
"""Seconds after which a case counts as hanging, however it takes the interrupts."""
ROOT = Path(__file__).parents[2]


class HangError(BaseException):
    """A case did not end in spite of interrupts."""


@dataclasses.dataclass
class Outcome:
    """The outcome of a case: "refused", "worked", "interrupted", or a problem in one line."""

    case: str
    did: str
    problem: str = ""
    trace: str = ""


Attack = Callable[[str], str]
"""Runs a case, and returns its outcome. Raises ProblemError if it breaks a rule."""


class ProblemError(Exception):
    """A rule that a case broke, in one line."""

    def __init__(self, text: str, error: BaseException | None = None) -> None:
        super().__init__(text if error is None else f"{text}: {place(error)}")
        self.error = error


def place(error: BaseException) -> str:
    """An error's type, the innermost function of the package that it came through, and its message."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "lyceum_warp/" in f.filename]
    frames = [f for f in frames if "/tests/" not in f.filename]
    where = f"{Path(frames[-1].filename).name}:{frames[-1].name}" if frames else "outside"
    return f"{type(error).__name__} at {where} ({' '.join(str(error).split())[:200]})"


_OUT_OF_MEMORY = ("can't allocate memory", "not enough memory", "bad_alloc", "could not allocate", "cannot allocate")


def out_of_memory(error: BaseException) -> bool:
    """Whether an error, or one that it followed from, is a failed allocation. The package's own refusal is none."""
    one: BaseException | None = error
    while one is not None:
        own = type(one).__module__.startswith("lyceum_warp")
        if not own and (isinstance(one, MemoryError) or any(word in str(one).lower() for word in _OUT_OF_MEMORY)):
            return True
        one = one.__cause__ or one.__context__
    return False


# the child


def serve(attack: Attack, warm_up: Callable[[], None]) -> None:
    """Run the cases that the command line names.

    Args:
        attack: Runs a case.
        warm_up: Called before the memory is limited: it loads what cases use.
    """
    results = sys.argv[2] if sys.argv[1:2] == ["--results"] else None
    cases = sys.argv[3:] if results else sys.argv[1:]
    warm_up()
    gc.collect()
    gc.freeze()
    with open(results, "a") if results else contextlib.nullcontext(sys.__stdout__) as file:
        for case in cases:
            print(json.dumps({"begin": case}), file=file, flush=True)
            gc.collect()  # environments of earlier cases
            size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, resource.RLIM_INFINITY))
            outcome = _guarded(attack, case)
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            print(json.dumps(dataclasses.asdict(outcome)), file=file, flush=True)
            if not results:
                print(outcome.trace)


def _guarded(attack: Attack, case: str) -> Outcome:
    try:
        with _limited():
            return Outcome(case, attack(case))
    except ProblemError as problem:
        text = "" if problem.error is None else "".join(traceback.format_exception(problem.error))
        return Outcome(case, "broke a rule", str(problem), text[-4000:])
    except KeyboardInterrupt:
        return Outcome(case, "interrupted")
    except BaseException as error:  # an attack itself does not fail
        return Outcome(case, "failed", f"the attack failed: {place(error)}", traceback.format_exc()[-4000:])


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    """Interrupt a case that takes long, as by Ctrl-C."""
    count = 0

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal count
        count += 1
        if count * PATIENCE > LIMIT:
            raise HangError(f"after {LIMIT:g} s, in spite of interrupts")
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGALRM, interrupt)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE, PATIENCE)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


# the parent


def attacks(program: str, cases: Sequence[str], folder: Path, *, seconds: float) -> dict[str, Outcome]:
    """Run cases in a child process, in a new one after one that died.

    Args:
        program: The file of the program, beside this one.
        cases: The cases.
        folder: A folder for files of the child.
        seconds: Time that the child may take without any result.
    """
    outcomes: dict[str, Outcome] = {}
    results = folder / "results.txt"
    environment = os.environ | {"MALLOC_ARENA_MAX": "1", "PYTHONPATH": str(ROOT), "COLUMNS": "120"}
    while left := [case for case in cases if case not in outcomes]:
        results.write_text("")
        command = [sys.executable, str(Path(__file__).parent / program), "--results", str(results), *left]
        with (folder / "output.txt").open("wb") as output:
            child = subprocess.Popen(command, cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT)
            died = _watched(child, results, seconds)
        lines: list[dict[str, Any]] = [json.loads(line) for line in results.read_text().splitlines()]
        outcomes |= {line["case"]: Outcome(**line) for line in lines if "case" in line}
        if not died:
            continue
        end = (folder / "output.txt").read_text(errors="replace")[-3000:]
        assert lines, f"{program} did not begin: {died}\n{end}"
        if "begin" in lines[-1]:
            case = lines[-1]["begin"]
            outcomes[case] = Outcome(case, "died", f"the process {died}", end)
    return outcomes


def _watched(child: "subprocess.Popen[bytes]", results: Path, seconds: float) -> str:
    """Wait for a child; returns how it died, or "" if it ended with 0. A child without progress is killed."""
    size = -1
    while True:
        try:
            code = child.wait(seconds)
            return f"ended with code {code}" if code else ""
        except subprocess.TimeoutExpired:
            if size == (size := results.stat().st_size):
                child.kill()
                child.wait()
                return f"did nothing for {seconds:g} s"


def replay(program: str, case: str) -> str:
    """The line that repeats a case."""
    return f"in an empty folder: PYTHONPATH={ROOT} {sys.executable} {Path(__file__).parent / program} {case!r}"
