"""Search settings with Optuna: lyceum-warp sweep."""

import contextlib
import dataclasses
import json
import math
import time
import tomllib
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from lyceum_warp import binding, training
from lyceum_warp.cli.display import say, say_entries
from lyceum_warp.cli.parsing import parse
from lyceum_warp.support.interrupts import Interrupted

_KEYS = {
    "task": str, "trials": int, "out": str, "storage": str, "objective": str, "direction": str, "sampler": str,
    "pruner": str, "heartbeat": int, "settings": dict, "ranges": dict,
}  # fmt: skip


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
        try:
            import optuna
        except ImportError as error:
            raise ImportError("sweeps need optuna: pip install 'lyceum-warp[sweep]'") from error
        sweep = _read(self.file)
        out = Path(sweep["out"])
        out.mkdir(parents=True, exist_ok=True)
        beat = sweep.get("heartbeat", 60)
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)  # heartbeats are experimental
        storage = optuna.storages.RDBStorage(
            sweep.get("storage", f"sqlite:///{out.resolve()}/sweep.db"), heartbeat_interval=beat, grace_period=2 * beat,
            heartbeat_stale_trial_callback=optuna.storages.RetryHeartbeatStaleTrialCallback(),
        )  # fmt: skip
        gate = sweep.get("objective") == "gate"
        study = optuna.create_study(
            storage=storage, study_name=self.file.stem, load_if_exists=True,
            direction=sweep.get("direction", "minimize" if gate else "maximize"),
            sampler=getattr(optuna.samplers, sweep.get("sampler", "TPESampler"))(),
            pruner=getattr(optuna.pruners, sweep.get("pruner", "MedianPruner"))(),
        )  # fmt: skip
        objective = _objective(sweep, out)
        while True:
            optuna.storages.fail_stale_trials(study)
            states = [trial.state.name for trial in study.get_trials(deepcopy=False)]
            done = states.count("COMPLETE") + states.count("PRUNED")
            if done >= sweep["trials"]:
                break
            if done + states.count("RUNNING") >= sweep["trials"]:
                time.sleep(min(beat, 5))  # another worker finishes the last trials, or has been killed
                continue
            study.optimize(objective, n_trials=1)
            last = study.get_trials(deepcopy=False)[-1]
            say(f"trial {last.number}: {last.state.name.lower()} {'' if last.value is None else f'{last.value:.6g}'} "
                f"{last.params}")  # fmt: skip
        completed = study.get_trials(deepcopy=False, states=[optuna.trial.TrialState.COMPLETE])
        if not completed:
            raise ValueError(f"no trial of {self.file} has been completed: see the logs in {out}")
        best = study.best_trial
        words = " ".join([sweep["task"], *training.flag_words(best.user_attrs["settings"])])
        say_entries(
            best=f"trial {best.number}, {best.value:.6g}: {best.params}; its run is {best.user_attrs['run']}",
            next=f"lyceum-warp train {words} --seeds 5, or lyceum-warp plot {out}",
        )


def _read(file: Path) -> dict[str, Any]:
    try:
        sweep = tomllib.loads(file.read_text())
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{file}: {error}") from error
    for name, value in sweep.items():
        if not isinstance(value, _KEYS.get(name, ())):
            raise ValueError(f"{file}: {name} = {value!r} is not one of {', '.join(_KEYS)} with its type")
    if missing := [name for name in ("task", "trials", "out", "ranges") if name not in sweep]:
        raise ValueError(f"{file} lacks {missing[0]}: see lyceum-warp sweep --help")
    return sweep


def suggestion(trial: Any, name: str, entry: Mapping[str, Any]) -> Any:
    """Let a trial choose a value in a range, such as ``{"low": 0.1, "high": 1.0}`` or ``{"choices": [...]}``."""
    try:
        if "choices" in entry:
            # Optuna stores only single values
            words = {json.dumps(x) if isinstance(x, list) else x: x for x in entry["choices"]}
            return words[trial.suggest_categorical(name, list(words))]
        whole = isinstance(entry["low"], int) and isinstance(entry["high"], int)
        return (trial.suggest_int if whole else trial.suggest_float)(name, **entry)
    except (TypeError, KeyError, ValueError) as error:
        raise ValueError(f"the range {name} = {entry!r} needs low and high, or choices: {error}") from error


def _objective(sweep: Mapping[str, Any], out: Path) -> Callable[[Any], float]:
    import optuna

    from lyceum_warp.cli.train import Train

    goal = sweep.get("objective", "return")
    judge = {"return": _best_return, "gate": _gate_seconds}.get(goal) or binding.object_in_file(goal)

    def objective(trial: Any) -> float:
        settings = dict(sweep.get("settings", {}))
        for name, entry in sweep["ranges"].items():
            value, (first, _, part) = suggestion(trial, name, entry), name.partition(".")
            settings[first] = {**settings.get(first, {}), part: value} if part else value
        folder = Path(trial.user_attrs.get("run", out / f"trial-{trial.number:04d}"))  # a killed trial goes on
        trial.set_user_attr("run", str(folder))
        trial.set_user_attr("settings", settings)

        def report(iteration: Any) -> None:
            value = iteration.return_mean if iteration.mean_return is None else iteration.mean_return
            if value is not None and math.isfinite(value) and goal == "return":
                trial.report(value, iteration.iteration)
                if trial.should_prune():
                    raise optuna.TrialPruned

        words = [sweep["task"], *training.flag_words(settings), "--continue", "--out", str(folder)]
        command = parse(Train, "lyceum-warp train", words)
        with folder.with_suffix(".log").open("a") as log, contextlib.redirect_stdout(log):
            try:
                code = command.run([report])
            except FloatingPointError as error:
                raise optuna.TrialPruned from error
        if code >= 128:
            raise Interrupted(code - 128)  # the trial stays open until its heartbeat is missed
        return float(judge(training.Run.open(folder)))

    return objective


def _best_return(run: Any) -> float:
    """Return the mean return of the better policy in new episodes, which ``train`` has stored at the end."""
    return max(float(score["mean"]) for score in json.loads(run.evaluation.read_text())["policies"].values())


def _gate_seconds(run: Any) -> float:
    """Return the seconds of sampling and updates until the gate was passed; infinity if it was not."""
    passed = run.config.get("passed")
    if passed is None:
        return math.inf
    rows = run.rows()[: passed["iteration"]]
    return sum(
        value or 0.0 for row in rows for name, value in row.items() if name.startswith("time_") and name != "time_mean"
    )
