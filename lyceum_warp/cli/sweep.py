"""Search settings with Optuna: lyceum-warp sweep."""

import contextlib
import dataclasses
import functools
import json
import math
import tomllib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from lyceum_warp import binding, training, viz
from lyceum_warp.cli.display import say, say_entries
from lyceum_warp.cli.parsing import parse
from lyceum_warp.cli.train import Train
from lyceum_warp.support.extras import check_extra
from lyceum_warp.support.interrupts import Interrupted
from lyceum_warp.support.validate import check_kind


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sweep:
    """Search settings of training with Optuna, as a TOML file describes. Each trial is a run of lyceum-warp train.

    The command is one worker, and continues a sweep that has begun. Start it several times, at any time and, with a
    storage that all machines reach, on any machine. If a worker is killed, Optuna releases its trial after two
    heartbeats, and another worker continues the run of the trial.

    $ lyceum-warp sweep hopper.toml

    A file has task, trials, out, and the tables settings and ranges, whose keys are options of lyceum-warp train:

        task = "hopper"
        trials = 30
        out = "runs/hopper-sweep"
        settings = { iterations = 40, nworld = 16 }
        [ranges]
        gamma = { low = 0.98, high = 0.999 }
        delta = { low = 0.01, high = 0.3, log = true }
        hidden = { choices = [[32, 32], [64, 64]] }
        "param.ctrl_cost_weight" = { low = 1e-4, high = 1e-2, log = true }
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """The TOML file. Its optional keys: objective ("return", the default; "gate", the seconds of training until a
    policy passes; or path/to/file.py:function, whose number of a lw.Run is maximized), storage (a database's URL; by
    default an SQLite file in out), sampler and pruner (names of Optuna's classes), and heartbeat (60 seconds)."""

    def run(self) -> None:
        check_extra("a sweep", "sweep", "optuna")
        import optuna
        from optuna.trial import TrialState

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)  # heartbeats are experimental
        done = (TrialState.COMPLETE, TrialState.PRUNED)
        try:
            search = Search(**tomllib.loads(self.file.read_text()))
            check_search(search)
            study = _study(search, self.file.stem)
            if len(study.get_trials(deepcopy=False, states=done)) < search.trials:
                enough = optuna.study.MaxTrialsCallback(search.trials, states=done)
                study.optimize(functools.partial(_objective, search), callbacks=[_say_trial, enough])
            if not study.get_trials(deepcopy=False, states=done[:1]):
                raise ValueError("all trials were pruned: none has passed the gate, or all have diverged")
            best = study.best_trial
        except Exception as error:  # Optuna and databases raise many types of errors
            raise ValueError(f"{self.file}: {viz.one_line(error).removeprefix('Search.__init__() ')}") from error
        arguments = " ".join([search.task, *training.flag_words(best.user_attrs["settings"])])
        say_entries(
            best=f"trial {best.number}, {best.value:.6g}: {best.params}; its run is {best.user_attrs['run']}",
            next=f"lyceum-warp train {arguments} --seeds 5, or lyceum-warp plot {search.out}",
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Search:
    """The content of a sweep's file."""

    task: str
    trials: int
    out: str
    ranges: dict
    settings: dict = dataclasses.field(default_factory=dict)
    objective: str = "return"
    storage: str | None = None
    sampler: str = "TPESampler"
    pruner: str = "MedianPruner"
    heartbeat: int = 60

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            check_kind(field.name, getattr(self, field.name), field.type, "see lyceum-warp sweep --help")


def check_search(search: Search) -> None:
    """Check the ranges, and make the learners of their ends, before anything is written."""
    import optuna

    if search.objective not in ("return", "gate"):
        binding.object_in_file(search.objective)
    trial_settings(search, optuna.create_study().ask())
    ends = {name: _words(entry) if "choices" in entry else [entry["low"], entry["high"]]
            for name, entry in search.ranges.items()}  # fmt: skip
    for k in range(max(map(len, ends.values()), default=1)):
        trial = optuna.trial.FixedTrial({name: values[k % len(values)] for name, values in ends.items()})
        settings = trial_settings(search, trial)
        if search.objective == "gate" and not (settings.get("gate_every") and binding.find_task(search.task).gate):
            raise ValueError('the objective "gate" needs a task with a gate, and gate_every in settings')
        _command(search, settings).check()


def trial_settings(search: Search, trial: Any) -> dict[str, Any]:
    """Return a trial's settings: those of the file, and values that the trial chooses in the ranges."""
    settings = dict(search.settings)
    for name, entry in search.ranges.items():
        first, _, part = name.partition(".")
        try:
            if "choices" in entry:
                value = json.loads(trial.suggest_categorical(name, _words(entry)))
            else:
                whole = isinstance(entry["low"], int) and isinstance(entry["high"], int)
                value = (trial.suggest_int if whole else trial.suggest_float)(name, **entry)
            settings[first] = {**settings.get(first, {}), part: value} if part else value
        except (TypeError, KeyError, ValueError, OverflowError) as error:
            raise ValueError(f"the range {name} = {entry!r} needs low and high, or choices: {error}") from error
    return settings


def _words(entry: Mapping[str, Any]) -> list[str]:
    """Convert choices to JSON, because Optuna stores single values only."""
    return [json.dumps(choice) for choice in entry["choices"]]


def _command(search: Search, settings: Mapping[str, Any], *more: str) -> Train:
    """Make the command that trains a trial."""
    return parse(Train, "lyceum-warp train", [search.task, *training.flag_words(settings), *more])


def _study(search: Search, name: str) -> Any:
    """Open the study of a sweep, or create it."""
    import optuna

    out = Path(search.out)
    sampler, pruner = getattr(optuna.samplers, search.sampler)(), getattr(optuna.pruners, search.pruner)()
    out.mkdir(parents=True, exist_ok=True)
    storage = optuna.storages.RDBStorage(
        search.storage or f"sqlite:///{out.resolve()}/sweep.db", heartbeat_interval=search.heartbeat,
        heartbeat_stale_trial_callback=optuna.storages.RetryHeartbeatStaleTrialCallback(),
    )  # fmt: skip
    return optuna.create_study(
        storage=storage, study_name=name, load_if_exists=True, sampler=sampler, pruner=pruner,
        direction="minimize" if search.objective == "gate" else "maximize",
    )  # fmt: skip


def _say_trial(study: Any, trial: Any) -> None:
    value = "" if trial.value is None else f"{trial.value:.6g}"
    say(f"trial {trial.number}: {trial.state.name.lower()} {value} {trial.params}")


def _objective(search: Search, trial: Any) -> float:
    """Train a trial, and return the number by which it is judged."""
    import optuna

    settings, by_return = trial_settings(search, trial), search.objective == "return"
    # a trial that was killed goes on
    folder = Path(trial.user_attrs.get("run", Path(search.out, f"trial-{trial.number:04d}")))
    trial.set_user_attr("run", str(folder))
    trial.set_user_attr("settings", settings)

    def report(iteration: Any) -> None:
        value = iteration.return_mean if iteration.mean_return is None else iteration.mean_return
        if value is not None and math.isfinite(value):
            trial.report(value, iteration.iteration)
            if trial.should_prune():
                raise optuna.TrialPruned

    # a worker on another host, whose trial Optuna has released, has left its lock
    flags = [*["--evaluate"] * by_return, "--continue", "--take-over", "--out", str(folder)]
    with folder.with_suffix(".log").open("a") as log, contextlib.redirect_stdout(log):
        try:
            code = _command(search, settings, *flags).run([report] * by_return)
        except FloatingPointError as error:
            raise optuna.TrialPruned from error
    if code >= 128:
        raise Interrupted(code - 128)  # the trial stays open until its heartbeat is missed
    run = training.Run.open(folder)
    if by_return:  # of the better policy in new episodes, as train --evaluate has stored it
        return max(score.mean for score in training.stored_scores(run).values())
    if search.objective != "gate":
        return float(binding.object_in_file(search.objective)(run))
    if "passed" not in run.config:
        raise optuna.TrialPruned
    return sum(map(training.row_seconds, run.rows()[: run.config["passed"]["iteration"]]))
