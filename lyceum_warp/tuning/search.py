"""Search for the fastest physics options that do not change a task's returns: `lw.tune`."""

import dataclasses
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lyceum_warp.algos import check_sizes
from lyceum_warp.binding import file_name, find_task, task_name
from lyceum_warp.core import EnvOptions, Task
from lyceum_warp.env import Env
from lyceum_warp.support.validate import check_word, whole_number
from lyceum_warp.training import Configuration, Run, load
from lyceum_warp.tuning.candidates import Setting, candidates, combined, flags, task_line
from lyceum_warp.tuning.judgement import TOLERANCES, verdict
from lyceum_warp.tuning.ranking import Rankings
from lyceum_warp.tuning.row_file import RowFile, identity
from lyceum_warp.tuning.trial import FULL, SHORT, Trials

NWORLD, GPU_NWORLD = 256, 4096
"""Default number of worlds, on a CPU and on a GPU."""

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Results of ``tune``."""

    rows: list[Row]
    """Results of each setting, the fastest first. docs/physics.md describes the entries. The entry ``verdict`` is
    "same" if the intervals of the returns (and of the fraction of clearly worse episodes, for tasks without
    terminations) lie within the tolerance. It is "different" if an interval lies outside, and "not shown" if it lies
    partly outside. The verdict is "faults" if there are more than twice as many faults as in the
    unchanged task. The verdict is "no gain", without a comparison of returns, if the setting is less than 3 % faster
    and saves no memory. The verdict is "refused" if MuJoCo or the engine raises an error for the setting. The entry
    ``refused`` then contains the error. A planner's setting may also get the verdict "ranks badly"."""
    reference: Row
    """Results of a comparison of the unchanged task with itself."""
    path: Path
    """Path of the results file."""

    @property
    def best(self) -> Row | None:
        """Return the fastest setting whose verdict is "same", or None."""
        return next((row for row in self.rows if row["verdict"] == "same"), None)

    @property
    def flags(self) -> str:
        """Write the best setting as flags for the commands ``train`` and ``plan``, or "" if there is none."""
        return flags(self.best["physics"]) if self.best else ""

    @property
    def task_line(self) -> str:
        """Write the best setting as the class attribute ``physics`` of a task, or "" if there is none."""
        return task_line(self.best["physics"]) if self.best else ""


def tune(
    task: str | type[Task],
    *,
    run: str | Path | None = None,
    which: str = "last",
    tolerance: str = "strict",
    short: bool = False,
    episodes: int | None = None,
    planning: bool = False,
    out: str | Path | None = None,
    seed: int = 0,
    progress: Callable[[Row], object] | None = None,
    **options: Any,
) -> Tuning:
    """Find the fastest physics options that do not change a task's returns.

    Every setting is compared with the unchanged task in the same process, by steps per second, memory, faults
    and returns. Returns are compared on pairs of episodes with the same initial states and random numbers.
    Settings are first tried alone. Then the best settings of all groups are combined. If the combination changes the
    returns, the setting with the smallest speed-up is removed, and the rest is tried again.

    Args:
        task: A task's name, file or class.
        run: Folder of a run of the same task. Returns are then also compared under the run's policy, and the run's
            parameters replace the task's defaults.
        which: Policy of the run: "last", "best", or the number of a saved iteration.
        tolerance: Bound on the 95 % interval of the difference of returns, relative to the mean absolute return. It is
            "strict" (2 %), "loose" (5 %) or "any" (only faults count). For tasks without terminations, it is also the
            bound on the interval of the fraction of clearly worse episodes.
        short: Whether to compare only the first 100 steps of episodes, which takes a few seconds.
        episodes: Number of episodes per setting, rounded up to a multiple of the number of worlds. The default gives a
            narrow interval, unless the episodes would take more than a minute (5 s with ``short``).
        planning: If True, find physics options for the worlds of the task's planner. The search then compares planning
            times. It also compares how the planners rank the same samples. The samples start from standing,
            moving and fallen states. The search suggests a setting if the interval of the mean rank correlation lies
            above 0.9 ("strict") or 0.8 ("loose"). ``nworld`` is then the number of samples, by default 64, and
            ``episodes`` is the number of states of each kind.
        out: File of the results. Rows are appended, and settings with a row are not measured again. By default
            tune/TASK.jsonl, or tune/TASK-planning.jsonl.
        seed: Seed of initial states and actions.
        progress: Called with each row of results.
        options: Options and parameters for ``lw.make``; by default 256 worlds on the CPU, and 4096 worlds on a GPU.

    Raises:
        ValueError: An argument is unknown or not valid, or the run belongs to a different task.
        FileNotFoundError: A model, a task or a run is missing.
    """
    check_word("tolerance", tolerance, list(TOLERANCES))
    if episodes is not None:
        whole_number("episodes", episodes, low=1)
    kind = find_task(task)
    measured: dict[str, Any] = {"short": short, "episodes": episodes, "seed": seed}
    trials: Rankings | Trials
    if planning:
        if run is not None:
            raise ValueError("planning=True compares samples of the planner and uses no run: omit planning or the run")
        states, repeats = (4, 3) if short else (16, 15)
        if "nworld" in options:
            options["samples"] = options.pop("nworld")
        trials = Rankings(kind, states=episodes or states, repeats=repeats, seed=seed, **options)
        measured["planner"] = trials.exact.settings
    else:
        env_options, params = EnvOptions.split(options)
        if "nworld" not in options:
            on_gpu = str(env_options.device).startswith("cuda")
            env_options = env_options.changed({"nworld": GPU_NWORLD if on_gpu else NWORLD})
        env_options = env_options.changed({"autoreset": False})
        policy = digest = None
        if run is None:
            env = Env(kind, env_options, params)
        else:
            source = Run.open(run)
            if source.task_name != task_name(kind):
                raise ValueError(
                    f"{run} is a run of the task {source.task_name!r}, not of the task {task_name(kind)!r}"
                )
            env = Env(kind, env_options, {**Configuration.of(source).params, **params})
            policy = load(source, which=which, device=env.obs.device)
            check_sizes(policy, env, f"the policy of {run}")
            digest = hashlib.sha256(source.policy_file(which).read_bytes()).hexdigest()[:16]
        measured["policy"] = digest
        trials = Trials(env, policy, effort=SHORT if short else FULL, seed=seed, episodes=episodes)
    name = f"{file_name(task_name(kind))}{'-planning' * planning}.jsonl"
    file = RowFile(Path("tune", name) if out is None else Path(out), identity(trials.reference, **measured))
    return _search(trials, file, tolerance, progress)


def _search(
    trials: Trials | Rankings, file: RowFile, tolerance: str, progress: Callable[[Row], object] | None
) -> Tuning:
    def row_of(setting: Setting) -> Row:
        row = file.get(setting.physics) or file.add(trials.measure(setting))
        row = {**row, "verdict": verdict(row, tolerance) if setting.physics else "reference"}
        if progress is not None:
            progress(row)
        return row

    reference = row_of(Setting("", "", {}))
    pairs = [(setting, row_of(setting)) for setting in candidates(trials.reference)]
    rows = [row for _, row in pairs]
    pairs.sort(key=lambda pair: -pair[1].get("speedup", 0.0))
    settings = [setting for setting, row in pairs if row["verdict"] == "same"]
    while (combination := combined(settings)) is not None:
        row = row_of(combination)
        if row["name"] == combination.name:
            rows.append(row)
        if row["verdict"] == "same":
            break
        settings = settings[: settings.index(combination.parts[-1])]
    rows.sort(key=lambda row: -row.get("speedup", 0.0))
    return Tuning(rows, reference, file.path)
