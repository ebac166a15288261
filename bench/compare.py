"""Report every bitwise difference between the results of two checkouts.

    lyceum-warp bench compare main
    lyceum-warp bench compare v0.1.0 HEAD --parts env plans --tasks hopper reach
    lyceum-warp bench compare ../before ../after --short --ignore '*/metrics.csv/new_column'

OLD and NEW are git revisions or folders with a checkout; NEW is this working tree by default. Each checkout runs in a
subprocess with the same packages, and uses only public names (probes/checkout.py). OLD runs again in every comparison,
because its numbers depend on the processor.

Exit code: 0 without differences, 1 with differences, 2 for bad input.
"""

import contextlib
import dataclasses
import fnmatch
import io
import json
import os
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

ROOT = Path(__file__).resolve().parents[1]
PROBE = ROOT / "bench" / "probes" / "checkout.py"
PACKAGE = "lyceum_warp"
LINES = 12

Part = Literal["env", "plans", "learners", "commands"]
PARTS: tuple[Part, ...] = ("env", "plans", "learners", "commands")
ENGINES = ("mujoco", "warp")

EVERY_VARIANT = ("MPPI", "CEM", "PredictiveSampling", "knots", "plants", "control")
MANY_PLANNERS = ("point_mass", "reach", "hopper")
"""Tasks on which every planner is compared. On other tasks, only MPPI is compared."""
LEARNING = {"mujoco": ("point_mass", "hopper", "go1_velocity"), "warp": ("hopper",)}
"""For each engine, the tasks on which learners are compared."""
COMMANDS = {"mujoco": ("hopper",), "warp": ("point_mass",)}
SHORT = ("point_mass", "reach", "hopper", "go1_velocity")
"""Tasks of a comparison with --short."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Report every bitwise difference between the results of two checkouts."""

    old: tyro.conf.Positional[str]
    """A git revision, or a folder with a checkout."""
    new: tyro.conf.Positional[str] = str(ROOT)
    """The revision or folder to compare with; by default this working tree."""
    tasks: tuple[str, ...] = ()
    """Tasks to compare; by default all. By default, the parts "learners" and "commands" use only a few tasks."""
    engines: tuple[Literal["mujoco", "warp"], ...] = ENGINES
    """Engines."""
    device: str = "cpu"
    """Device of the Warp engine, for example cuda. On a GPU, the engine is deterministic."""
    parts: tuple[Part, ...] = PARTS
    """Parts to compare; by default all. The part "env" compares models, resets, steps, getters, a fault and a rollout.
    The part "plans" compares plans of all planners, and episodes under lw.control. The part "learners" compares NPG and
    PPO, with their final networks. The part "commands" compares the metrics.csv and the policies of lyceum-warp train,
    with and without an interruption."""
    steps: int = 20
    """Number of steps of an environment."""
    iterations: int = 10
    """Number of iterations of a learner."""
    ignore: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="PATTERN")] = ()
    """Names to ignore, such as '*/metrics.csv/*' or 'plans/hopper/*'; may be repeated."""
    short: bool = False
    """Compare only four tasks. The parts "plans" and "commands" run only on the C engine. On two cores, a
    comparison with --short takes about 3 minutes, and a full one about 16, if all kernels are compiled already."""


@dataclasses.dataclass(frozen=True)
class Unit:
    """A unit of work: one part for one task on one engine."""

    part: Part
    task: str
    engine: str
    more: Mapping[str, Any]
    variant: str = ""

    @property
    def name(self) -> str:
        return "/".join(filter(None, (self.part, self.task, self.engine, self.variant)))


@dataclasses.dataclass(frozen=True)
class Mismatch:
    """A difference between two arrays of the same name, or a failure of a checkout."""

    name: str
    text: str


# arrays


def unequal(old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Return a flat mask of the elements that differ in any bit."""
    rows = [np.ascontiguousarray(a).reshape(-1).view(np.uint8).reshape(a.size, a.itemsize) for a in (old, new)]
    return (rows[0] != rows[1]).any(axis=1)


def difference(name: str, old: np.ndarray, new: np.ndarray, axes: Sequence[str] = ()) -> Mismatch | None:
    if old.dtype.kind == new.dtype.kind == "U" and old.shape == new.shape:  # the dtype of a string contains its length
        longer = max(old.dtype, new.dtype)
        old, new = old.astype(longer), new.astype(longer)
    if (old.dtype, old.shape) != (new.dtype, new.shape):
        return Mismatch(name, f"{old.dtype} {old.shape} -> {new.dtype} {new.shape}")
    if not old.size or not (which := unequal(old, new)).any():
        return None
    place = np.unravel_index(int(which.argmax()), old.shape)
    labels = [axes[i] if i < len(axes) else f"index {i - len(axes)}" for i in range(old.ndim)]
    if old.ndim == len(axes) + 1:
        labels[-1] = "index"
    where = ", ".join(f"{label} {int(i)}" for label, i in zip(labels, place, strict=True))
    text = f"{old[place]} -> {new[place]}" + (f" at {where}" if where else "")
    if old.dtype.kind != "U":
        with np.errstate(all="ignore"):
            gaps = np.abs(new.astype(np.float64) - old.astype(np.float64)).reshape(-1)[which]
        text += f"; max |difference| {gaps.max():.6g}; {which.sum():,} of {old.size:,} differ"
    return Mismatch(name, text)


def differences(
    unit: str, old: Mapping[str, np.ndarray], new: Mapping[str, np.ndarray], axes: Mapping[str, Sequence[str]]
) -> Iterator[Mismatch]:
    names = [*old, *(name for name in new if name not in old)]
    for name in names:
        path = f"{unit}/{name}"
        if name not in new:
            yield Mismatch(path, f"removed: {old[name].dtype} {old[name].shape}")
        elif name not in old:
            yield Mismatch(path, f"added: {new[name].dtype} {new[name].shape}")
        elif (change := difference(path, old[name], new[name], axes.get(name, ()))) is not None:
            yield change


# checkouts


@contextlib.contextmanager
def checkout(source: str, folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield a checkout's folder and its description. Unpack a git revision into the empty ``folder`` first."""
    if Path(source, PACKAGE, "__init__.py").is_file():
        yield Path(source).resolve(), str(Path(source).resolve())
        return
    git = ["git", "-C", str(ROOT)]
    revision = subprocess.run(
        [*git, "rev-parse", "--verify", "--quiet", f"{source}^{{commit}}"], capture_output=True, text=True, check=False
    )
    if revision.returncode:
        raise ValueError(f"{source!r} is neither a folder with {PACKAGE}/ nor a revision of git: give one of them")
    commit = revision.stdout.strip()
    packed = subprocess.run([*git, "archive", "--format=tar", commit, PACKAGE], capture_output=True, check=True).stdout
    with tarfile.open(fileobj=io.BytesIO(packed)) as files:
        files.extractall(folder, filter="data")
    yield folder.resolve(), f"{source} ({commit[:10]})"


class Side:
    """The subprocess of a checkout, which restarts if it has died."""

    def __init__(self, name: str, root: Path, folder: Path) -> None:
        self.name, self.root, self.folder = name, root, folder
        self._file, self._log = folder / "arrays.npz", folder / "stderr.txt"
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        path = os.pathsep.join([str(self.root), *filter(None, [os.environ.get("PYTHONPATH")])])
        # Warp's compiler leaves temporary files here if the process is killed
        variables = {"PYTHONPATH": path, "TMPDIR": str(self.folder), "CUBLAS_WORKSPACE_CONFIG": ":4096:8"}
        with self._log.open("w") as log:
            # -P keeps bench/ off sys.path, where its modules could shadow others
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(PROBE), str(self._file)], cwd=self.folder, env=os.environ | variables,
                text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, start_new_session=True,
            )  # fmt: skip

    def contents(self) -> dict[str, Any]:
        contents = self.answer()
        if "file" in contents and not Path(contents["file"]).is_relative_to(self.root):
            text = f"imports {contents['file']} instead of {self.root}"
            return {"failure": {"text": text, "trace": "", "missing": False}}
        return contents

    def ask(self, unit: Mapping[str, Any]) -> None:
        self._file.unlink(missing_ok=True)
        if self._process is None:
            self.start()
            self.answer()
        assert self._process is not None and self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # answer() reports an ended process
            print(json.dumps(unit), file=self._process.stdin, flush=True)

    def answer(self) -> dict[str, Any]:
        assert self._process is not None and self._process.stdout is not None
        if line := self._process.stdout.readline():
            return json.loads(line)
        code = self._process.wait()
        self.close()
        trace = self._log.read_text(errors="replace")
        return {"failure": {"text": f"the process ended with {code}", "trace": trace, "missing": False}}

    def arrays(self) -> dict[str, np.ndarray]:
        if not self._file.exists():
            return {}
        with np.load(self._file) as file:
            return dict(file)

    def close(self) -> None:
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.communicate()
            self._process = None


# units


def units(options: Options, tasks: Sequence[str], learners: Sequence[str]) -> Iterator[Unit]:
    requested = set(options.tasks)

    def selection(default: Sequence[str]) -> list[str]:
        if requested and not requested & set(default):
            return list(tasks)
        return [task for task in default if task in tasks]

    for part in PARTS:
        if part not in options.parts:
            continue
        for engine in ENGINES:
            if engine not in options.engines or (options.short and part in ("plans", "commands") and engine == "warp"):
                continue
            if part == "env":
                yield from (Unit(part, task, engine, {"steps": options.steps}) for task in tasks)
            elif part == "plans":
                for task in tasks:
                    variants = EVERY_VARIANT if task in MANY_PLANNERS else EVERY_VARIANT[:1]
                    yield Unit(part, task, engine, {"variants": variants})
            elif part == "learners":
                for task in selection(LEARNING[engine]):
                    for learner in learners:
                        more = {"learner": learner, "iterations": options.iterations}
                        yield Unit(part, task, engine, more, learner)
            else:
                for task in selection(COMMANDS[engine]):
                    yield Unit(part, task, engine, {"iterations": options.iterations})


@dataclasses.dataclass
class Report:
    ignore: Sequence[str]
    differences: list[Mismatch] = dataclasses.field(default_factory=list)
    skipped: list[str] = dataclasses.field(default_factory=list)
    """Names of the units whose models are missing."""
    differing: int = 0
    units: int = 0
    arrays: int = 0
    ignored: int = 0

    def selects(self, name: str) -> bool:
        if any(fnmatch.fnmatchcase(name, pattern) for pattern in self.ignore):
            self.ignored += 1
            return False
        return True

    def add(self, name: str, differences: Sequence[Mismatch], seconds: float = 0.0, arrays: int = 0) -> None:
        """Add the differences found in a unit of work, and print them."""
        self.differences += differences
        self.differing += bool(differences)
        self.units += 1
        self.arrays += arrays
        summary = f"{len(differences)} differences" if differences else "equal"
        print(f"{name}: {summary}, {arrays} arrays, {seconds:.1f} s", flush=True)
        for each in differences[:LINES]:
            print(f"    {each.name.removeprefix(f'{name}/')}: {each.text}", flush=True)
        if len(differences) > LINES:
            print(f"    and {len(differences) - LINES} more", flush=True)


def failures(name: str, answers: Mapping[str, Mapping[str, Any]]) -> list[Mismatch]:
    """Return a unit's failures. If both checkouts fail, this also counts as a difference."""
    failed = {side: answer["failure"] for side, answer in answers.items() if "failure" in answer}
    for failure in failed.values():
        print(failure["trace"], file=sys.stderr)
    return [Mismatch(name, f"{side} failed: {failure['text']}") for side, failure in failed.items()]


def compare_unit(unit: Unit, sides: Sequence[Side], device: str, report: Report) -> None:
    began = time.perf_counter()
    request = {"part": unit.part, "task": unit.task, "engine": unit.engine, "device": device, **unit.more}
    for side in sides:
        side.ask(request)
    answers = {side.name: side.answer() for side in sides}
    if all(answer.get("failure", {}).get("missing") for answer in answers.values()):
        report.skipped.append(unit.name)
        print(f"{unit.name}: skipped, {answers['new']['failure']['text']}", flush=True)
        return
    old, new = (
        {name: array for name, array in side.arrays().items() if report.selects(f"{unit.name}/{name}")}
        for side in sides
    )
    axes = {**answers["new"].get("axes", {}), **answers["old"].get("axes", {})}
    changes = [each for each in failures(unit.name, answers) if report.selects(each.name)]
    if changes:  # arrays that are missing because of a failure are not reported
        old, new = ({name: array for name, array in side.items() if name in old and name in new} for side in (old, new))
    changes += differences(unit.name, old, new, axes)
    report.add(unit.name, changes, time.perf_counter() - began, len({**old, **new}))


def compare(options: Options, sides: Sequence[Side], report: Report) -> None:
    for side in sides:
        side.start()
    contents = {side.name: side.contents() for side in sides}
    if failed := failures("package", contents):
        report.add("package", failed)
        return
    old, new = contents["old"]["tasks"], contents["new"]["tasks"]
    names = options.tasks or (SHORT if options.short else sorted({*old, *new}))
    for task in names:
        if task not in old and task not in new:
            raise ValueError(f"neither checkout has a task {task!r}: there are {', '.join(sorted({*old, *new}))}")
    one_sided = [
        Mismatch(f"tasks/{task}", "added" if task in new else "removed")
        for task in names
        if (task in old) != (task in new) and report.selects(f"tasks/{task}")
    ]
    if one_sided:
        report.add("tasks", one_sided)
    tasks = [task for task in names if task in old and task in new]
    learners = [name for name in contents["old"]["learners"] if name in contents["new"]["learners"]]
    for unit in units(options, tasks, learners):
        compare_unit(unit, sides, options.device, report)


# the program


def run(options: Options) -> Report:
    if options.steps < 1 or options.iterations < 2:
        raise ValueError("--steps must be at least 1 and --iterations at least 2, so that a run can be interrupted")
    report, began = Report(options.ignore), time.perf_counter()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="lyceum-warp-compare-")))
        sides = []
        for name, source in (("old", options.old), ("new", options.new)):
            for part in ("checkout", "files"):
                (folder / name / part).mkdir(parents=True)
            root, described = stack.enter_context(checkout(source, folder / name / "checkout"))
            print(f"{name}: {described}", flush=True)
            sides.append(Side(name, root, folder / name / "files"))
            stack.callback(sides[-1].close)
        compare(options, sides, report)
    seconds = time.perf_counter() - began
    if report.skipped:
        print(f"skipped, because of missing models: {', '.join(report.skipped)}")
    if report.ignored:
        print(f"excluded by --ignore: {report.ignored} names")
    compared = f"{report.arrays:,} arrays in {report.units} units, {seconds:.0f} s"
    print(f"{len(report.differences)} differences in {report.differing} units; {compared}" if report.differences
          else f"no difference: {compared}")  # fmt: skip
    return report


def main(options: Options) -> int:
    """Run the program; return 1 if there are differences, 2 for bad input, and 130 or 143 after a signal."""
    for number in (signal.SIGTERM, signal.SIGHUP):  # SIGTERM raises SystemExit, so temporary folders are removed
        signal.signal(number, lambda number, frame: sys.exit(128 + number))
    try:
        return 1 if run(options).differences else 0
    except ValueError as error:
        print(f"compare: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, prog="lyceum-warp bench compare")))
