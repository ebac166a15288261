"""Run attacks in a subprocess with limits on time and memory, and collect the problems.

An attack program calls ``serve``, and a test calls ``attacks``. ``python tests/fuzz/PROGRAM.py CASE ...`` repeats
single cases with tracebacks.
"""

import contextlib
import dataclasses
import faulthandler
import gc
import json
import os
import resource
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

MEMORY = 512 * 2**20
"""Bytes of address space that a case may allocate."""
PATIENCE = 3.0
"""Seconds after which a running case receives a SIGINT."""
LIMIT = 60.0
"""Seconds after which a case that ignores SIGINT is killed."""
FOLDER = Path(__file__).parent
PATHS = f"{FOLDER.parents[1]}{os.pathsep}{FOLDER.parent}"


@dataclasses.dataclass
class Outcome:
    case: str
    problem: str = ""
    """What went wrong, in one line; empty if the case worked, raised a documented error, or was interrupted."""
    trace: str = ""


Attack = Callable[[str], object]
"""A function that runs a case. It raises ProblemError if the case breaks a rule."""


class ProblemError(Exception):
    def __init__(self, text: str, error: BaseException | None = None) -> None:
        super().__init__(text if error is None else f"{text}: {place(error)}")
        self.error = error


def place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    frames = [f for f in frames if "lyceum_warp/" in f.filename and "/tests/" not in f.filename]
    where = f"{Path(frames[-1].filename).name}:{frames[-1].name}" if frames else "outside"
    return f"{type(error).__name__} at {where} ({' '.join(str(error).split())[:200]})"


_OUT_OF_MEMORY = ("can't allocate memory", "not enough memory", "bad_alloc", "could not allocate", "cannot allocate")


def out_of_memory(error: BaseException) -> bool:
    one: BaseException | None = error
    while one is not None:
        own = type(one).__module__.startswith("lyceum_warp")
        if not own and (isinstance(one, MemoryError) or any(word in str(one).lower() for word in _OUT_OF_MEMORY)):
            return True
        one = one.__cause__ or one.__context__
    return False


def serve(attack: Attack, warm_up: Callable[[], None]) -> None:
    """Run the cases that the command line names. ``warm_up`` loads modules before memory is limited."""
    results = sys.argv[2] if sys.argv[1:2] == ["--results"] else None
    cases = sys.argv[3:] if results else sys.argv[1:]
    os.environ["XDG_STATE_HOME"] = str(Path("state").absolute())
    warm_up()
    gc.collect()
    gc.freeze()
    with open(results, "a") if results else contextlib.nullcontext(sys.__stdout__) as file:
        for case in cases:
            print(json.dumps({"begin": case}), file=file, flush=True)
            gc.collect()
            size = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, resource.RLIM_INFINITY))
            faulthandler.dump_traceback_later(LIMIT, exit=True)
            outcome = _guarded(attack, case)
            faulthandler.cancel_dump_traceback_later()
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            print(json.dumps(dataclasses.asdict(outcome)), file=file, flush=True)
            if not results:
                print(outcome.trace)


def _guarded(attack: Attack, case: str) -> Outcome:
    before = signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGINT))
    try:
        signal.setitimer(signal.ITIMER_REAL, PATIENCE, PATIENCE)
        attack(case)
        return Outcome(case)
    except ProblemError as problem:
        text = "" if problem.error is None else "".join(traceback.format_exception(problem.error))
        return Outcome(case, str(problem), text[-4000:])
    except KeyboardInterrupt:
        return Outcome(case)
    except BaseException as error:
        return Outcome(case, f"the attack failed: {place(error)}", traceback.format_exc()[-4000:])
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def attacks(program: str, cases: Sequence[str], folder: Path) -> dict[str, Outcome]:
    """Run cases in a subprocess that restarts after each crash."""
    outcomes: dict[str, Outcome] = {}
    results = folder / "results.txt"
    environment = os.environ | {"MALLOC_ARENA_MAX": "1", "OMP_STACKSIZE": "64k", "PYTHONPATH": PATHS, "COLUMNS": "120"}
    while left := [case for case in cases if case not in outcomes]:
        results.write_text("")
        command = [sys.executable, str(FOLDER / program), "--results", str(results), *left]
        with (folder / "output.txt").open("wb") as output:
            code = subprocess.run(
                command, cwd=folder, env=environment, stdout=output, stderr=subprocess.STDOUT, check=False
            ).returncode
        lines: list[dict[str, Any]] = [json.loads(line) for line in results.read_text().splitlines()]
        outcomes |= {line["case"]: Outcome(**line) for line in lines if "case" in line}
        if code == 0:
            continue
        end = (folder / "output.txt").read_text(errors="replace")[-3000:]
        assert lines, f"{program} did not begin: {code}\n{end}"
        if "begin" in lines[-1]:
            case = lines[-1]["begin"]
            outcomes[case] = Outcome(case, f"the process ended with code {code}", end)
    return outcomes


def replay(program: str, case: str) -> str:
    return f"in an empty folder: PYTHONPATH={PATHS} {sys.executable} {FOLDER / program} {case!r}"
