"""Search settings with Optuna: lyceum-warp sweep."""

import contextlib
import dataclasses
import json
import math
import time
import tomllib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import tyro

from lyceum_warp import binding, training, viz
from lyceum_warp.cli.display import say, say_entries
from lyceum_warp.cli.parsing import parse
from lyceum_warp.support.extras import check_extra
from lyceum_warp.support.interrupts import Interrupted
from lyceum_warp.support.validate import check_kind, whole_number


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
    policy passes; or path/to/file.py:function of a lw.Run), direction, storage (a URL of Optuna; by default an SQLite
    file in out), sampler and pruner (names of Optuna's classes), and heartbeat (60 seconds)."""

    def run(self) -> None:
        check_extra("a sweep", "sweep", "optuna")
        import optuna

        search = read_search(self.file)
        out, beat = Path(search.out), search.heartbeat
        direction: Any = search.direction or ("minimize" if search.objective == "gate" else "maximize")
        out.mkdir(parents=True, exist_ok=True)
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)  # heartbeats are experimental
        try:
            study = optuna.create_study(
                storage=optuna.storages.RDBStorage(
                    search.storage or f"sqlite:///{out.resolve()}/sweep.db", heartbeat_interval=beat,
                    grace_period=2 * beat,
                    heartbeat_stale_trial_callback=optuna.storages.RetryHeartbeatStaleTrialCallback(),
                ),
                study_name=self.file.stem, load_if_exists=True,
                direction=direction,
                sampler=getattr(optuna.samplers, search.sampler)(), pruner=getattr(optuna.pruners, search.pruner)(),
            )  # fmt: skip
            _optimize(study, _objective(search), search)
            best = study.best_trial
        except Exception as error:  # Optuna and databases raise many types of errors
            raise ValueError(f"{self.file}: {viz.one_line(error)} (the logs of trials are in {out})") from error
        words = " ".join([search.task, *training.flag_words(best.user_attrs["settings"])])
        say_entries(
            best=f"trial {best.number}, {best.value:.6g}: {best.params}; its run is {best.user_attrs['run']}",
            next=f"lyceum-warp train {words} --seeds 5, or lyceum-warp plot {out}",
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
    direction: str | None = None
    storage: str | None = None
    sampler: str = "TPESampler"
    pruner: str = "MedianPruner"
    heartbeat: int = 60

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            check_kind(field.name, getattr(self, field.name), field.type, "see lyceum-warp sweep --help")
        whole_number("heartbeat", self.heartbeat, low=1)


def read_search(file: Path) -> Search:
    """Read a sweep's file."""
    try:
        return Search(**tomllib.loads(file.read_text()))
    except (ValueError, TypeError) as error:  # a name is missing or unknown
        raise ValueError(f"{file}: {str(error).removeprefix('Search.__init__() ')}") from error


def _optimize(study: Any, objective: Callable[[Any], float], search: Search) -> None:
    """Run trials until the sweep has enough. Other workers may run trials of the same study."""
    import optuna

    while True:
        optuna.storages.fail_stale_trials(study)
        states = [trial.state.name for trial in study.get_trials(deepcopy=False)]
        done = states.count("COMPLETE") + states.count("PRUNED")
        if done >= search.trials:
            return
        if done + states.count("RUNNING") >= search.trials:
            time.sleep(min(search.heartbeat, 5))  # another worker finishes the last trials, or has been killed
            continue
        study.optimize(objective, n_trials=1)
        last = study.get_trials(deepcopy=False)[-1]
        value = "" if last.value is None else f"{last.value:.6g}"
        say(f"trial {last.number}: {last.state.name.lower()} {value} {last.params}")


def trial_settings(search: Search, trial: Any) -> dict[str, Any]:
    """Return a trial's settings: those of the file, and values that the trial chooses in the ranges."""
    settings = dict(search.settings)
    for name, entry in search.ranges.items():
        first, _, part = name.partition(".")
        try:
            if "choices" in entry:  # Optuna stores only single values
                words = {json.dumps(x) if isinstance(x, list) else x: x for x in entry["choices"]}
                value = words[trial.suggest_categorical(name, list(words))]
            else:
                whole = isinstance(entry["low"], int) and isinstance(entry["high"], int)
                value = (trial.suggest_int if whole else trial.suggest_float)(name, **entry)
            settings[first] = {**settings.get(first, {}), part: value} if part else value
        except (TypeError, KeyError, ValueError, OverflowError) as error:
            raise ValueError(f"the range {name} = {entry!r} needs low and high, or choices: {error}") from error
    return settings


def _objective(search: Search) -> Callable[[Any], float]:
    import optuna

    from lyceum_warp.cli.train import Train

    judge = {"return": _best_return, "gate": _gate_seconds}.get(search.objective)
    judge = judge or binding.object_in_file(search.objective)

    def objective(trial: Any) -> float:
        settings = trial_settings(search, trial)
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

        by_return = search.objective == "return"
        words = [search.task, *training.flag_words(settings), *["--evaluate"] * by_return, "--continue", "--out"]
        command = parse(Train, "lyceum-warp train", [*words, str(folder)])
        with folder.with_suffix(".log").open("a") as log, contextlib.redirect_stdout(log):
            try:
                code = command.run([report] * by_return)
            except FloatingPointError as error:
                raise optuna.TrialPruned from error
        if code >= 128:
            raise Interrupted(code - 128)  # the trial stays open until its heartbeat is missed
        return float(judge(training.Run.open(folder)))

    return objective


def _best_return(run: Any) -> float:
    """Return the mean return of the better policy in new episodes, which ``train --evaluate`` has stored."""
    return max(float(score["mean"]) for score in json.loads(run.evaluation.read_text())["policies"].values())


def _gate_seconds(run: Any) -> float:
    """Return the seconds of sampling and updates until the gate was passed; infinity if it was not."""
    passed = run.config.get("passed")
    return math.inf if passed is None else sum(map(training.row_seconds, run.rows()[: passed["iteration"]]))
