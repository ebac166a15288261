"""Train a learner and write its run folder, as ``lw.train`` and ``lyceum-warp train`` do."""

import contextlib
import json
import logging
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lyceum_warp.algos import EXACT, Learner, task_physics
from lyceum_warp.binding import class_sources
from lyceum_warp.engines import engine_name
from lyceum_warp.support.interrupts import Interrupted, postponed
from lyceum_warp.support.validate import check_flag, check_kind, whole_number
from lyceum_warp.support.versions import versions
from lyceum_warp.training.callbacks import Callback
from lyceum_warp.training.runs.checkpoints import policy_content, write_content
from lyceum_warp.training.runs.configuration import describe
from lyceum_warp.training.runs.folder import NETWORK, Run
from lyceum_warp.training.runs.lock import run_lock
from lyceum_warp.training.runs.replay_files import read_replay
from lyceum_warp.training.runs.saving import Saver
from lyceum_warp.training.runs.task_copy import note_changes, note_uncopied_data, table_copies, task_copy

log = logging.getLogger(__name__)


def train(
    learner: Learner,
    run: str | Path | Run,
    iterations: int = 100,
    *,
    callbacks: Sequence[Callable[[Any], object]] = (),
    keep_every: int = 0,
    save_every: int = 0,
    exact_from: int | None = None,
    take_over: bool = False,
    entries: Mapping[str, Any] | None = None,
) -> Run:
    """Train a learner, and write metrics, policies and checkpoints into a run folder, as ``lyceum-warp train`` does.

    ``lw.load(folder)`` returns the last policy, and ``lw.load(folder, which="best")`` the policy with the best return.
    Policies are compared by ``mean_return`` if the learner evaluates the mean policy. Otherwise they are compared by
    ``return_mean``, the return of episodes under the policy before the update.

    The policy and the complete state are saved at the start, at the end, and every 30 s. Fast saves happen more often
    (``training/runs/saving.py``). A killed run resumes from the last save and produces the same numbers. After Ctrl-C,
    SIGTERM or SIGHUP, the run finishes the current iteration, is saved and ends. A second signal ends it at once.

    Example:
        >>> run = lw.train(lw.NPG(env), "runs/mine", 100, callbacks=[lw.TargetReturn(300.0), lw.Videos(50)])
        >>> lw.train(lw.NPG(env), lw.Run.open("runs/mine"), 200)  # continues the run

    Args:
        learner: The algorithm, such as ``NPG(env)``, or another ``lw.Learner``.
        run: The folder of a new run, which must be new or empty, or a run to continue, such as ``lw.Run.open(folder)``.
            To continue a run, make the learner with the same arguments as before.
        iterations: Total number of iterations, including those before resuming.
        callbacks: Called with each iteration, after the iteration's row was written: functions, or objects such as
            ``lw.TargetReturn``, ``lw.Minutes``, ``lw.Videos``, ``lw.TensorBoard``, ``lw.TransferTest`` or another
            ``lw.Callback``. Training ends if one of them returns True. If one raises an error, the run is saved and
            the error is raised again.
        keep_every: Iterations between policies that are saved in numbered files, or 0 for none.
        save_every: Iterations between saves, or 0 to save by time.
        exact_from: Number of iterations after which learning goes on in the task's "exact" physics, with the worlds,
            networks, optimisers and random streams as they are. By default, a run that is continued keeps its number.
        take_over: Whether to continue a run that another process has locked, on this or another host. That process then
            ends at its next write.
        entries: More JSON entries for config.json.

    Returns:
        The run; ``run.rows()`` returns its metrics.

    Raises:
        TypeError: With ``exact_from``, the learner's constructor has other arguments than ``Learner.enter`` passes.
        ValueError: The folder is not empty, an argument is out of range, the run does not fit the learner, or another
            process has locked the run.
        OSError: The folder cannot be written. The run can later be resumed from its last save.
        FloatingPointError: An update of the learner is not finite.
        Interrupted: One of several ranks received a signal.
    """
    check_kind("learner", learner, Learner, "as lw.NPG(env)")
    check_kind("run", run, str | Path | Run, "as 'runs/mine' or lw.Run.open('runs/mine')")
    check_kind("callbacks", callbacks, Sequence, "as [lw.Minutes(10)]")
    for callback in callbacks:
        check_kind("each of callbacks", callback, Callable, "a function or a lw.Callback")
    check_kind("entries", entries, Mapping | None, "as {'note': 'first try'}")
    check_flag("take_over", take_over)
    if exact_from is None and isinstance(run, Run):
        exact_from = run.config.get("exact_from")
    if exact_from is not None:
        learner.check_enter()
    settings: dict[str, Any] = {
        "iterations": whole_number("iterations", iterations, low=1),
        "keep_every": whole_number("keep_every", keep_every, low=0),
        "save_every": whole_number("save_every", save_every, low=0),
        "exact_from": None if exact_from is None else whole_number("exact_from", exact_from, low=1),
        **(entries or {}),
    }
    team, leads = learner.team, learner.team.leads
    if not leads:
        callbacks = ()
    observers = [callback for callback in callbacks if isinstance(callback, Callback)]
    for observer in observers:
        settings |= observer.settings
    with contextlib.ExitStack() as stack:
        with team.together(), contextlib.ExitStack() as undo:
            if isinstance(run, Run):
                settings |= _restore(run, learner, iterations, stack, take_over=take_over)
                saved = learner.iteration
            else:
                run, saved = _create(Path(run), learner, settings, stack, undo), -1
            for observer in observers:
                stack.callback(observer.close)
                observer.begin(run, learner, iterations)
            if leads and saved >= 0:
                run.cut(saved)  # a killed run may have unsaved rows
                run.amend(**settings)
            undo.pop_all()
        saver = Saver(run if leads else None, learner, keep_every=keep_every, save_every=save_every, saved=saved)
        try:
            _learn(learner, saver, iterations, math.inf if exact_from is None else exact_from, callbacks)
            for observer in observers:
                observer.end(run, learner)
        except Exception as error:
            if leads and saver.saved >= 0:
                error.add_note(f"the run in {run.folder} is saved up to iteration {saver.saved}")
            raise
    return run


def _restore(
    run: Run, learner: Learner, iterations: int, stack: contextlib.ExitStack, *, take_over: bool
) -> dict[str, Any]:
    """Lock a run, load its checkpoint into the learner, and return new entries for config.json."""
    leads = learner.team.leads
    if leads:
        run.check = stack.enter_context(run_lock(run.folder, take_over=take_over))
    _load_checkpoint(run, learner, iterations)
    return _changed_versions(run) if leads else {}


def _create(
    folder: Path, learner: Learner, settings: dict[str, Any], stack: contextlib.ExitStack, undo: contextlib.ExitStack
) -> Run:
    """Make the folder of a new run, and lock it. ``undo`` deletes it."""
    config = describe(learner) | settings
    if not learner.team.leads:
        return Run(folder, config)
    manifest, files = task_copy(learner.env)
    network = class_sources(type(getattr(learner.policy, "network", None)))
    files |= {f"{NETWORK}/{name}": content for name, content in network.items()}
    run = Run.create(folder, config | {"kept": manifest}, files=files)
    undo.callback(shutil.rmtree, folder, ignore_errors=True)
    run.check = stack.enter_context(run_lock(folder))
    note_uncopied_data(learner.env)
    if learner.teacher is not None:
        write_content(run.teacher, policy_content(0, learner.teacher))
    return run


def _learn(
    learner: Learner, saver: Saver, iterations: int, exact_from: float, callbacks: Sequence[Callable[[Any], object]]
) -> None:
    """Iterate until the last iteration, or until a callback ends the training. All ranks stop together."""
    team = learner.team
    ended = False
    with postponed(insist=team.size == 1) as signals:
        if saver.saved != learner.iteration:
            saver.save()
        while learner.iteration < iterations and not ended:
            env = learner.env
            if learner.iteration >= exact_from and task_physics(env)[1] != EXACT:
                same = {"seed": env.options.seed, "first_world": env.first_world, "horizon": env.options.horizon}
                learner.enter(env.replicate(physics=EXACT, **same))
            iteration, error = next(learner), None
            with team.together():
                saver.write(iteration)
            try:
                for callback in callbacks:
                    ended = callback(iteration) is True or ended
            except Exception as raised:
                error = raised
            ended = ended or error is not None or learner.iteration >= iterations
            failed = error is not None
            signal, last, any_failed, due = team.largest(max(signals, default=0), ended, failed, saver.due())
            if signal or last or due:
                saver.save()
            if error is not None:
                raise error
            if any_failed:
                raise SystemExit(2)
            if signal and team.size > 1:
                raise Interrupted(signal)
            ended = bool(last or signal)


def _load_checkpoint(run: Run, learner: Learner, iterations: int) -> None:
    content = run.read(learner.env.obs.device)
    done = content["iteration"]
    if iterations <= done:
        raise ValueError(
            f"the run in {run.folder} already has {done} iterations: ask for more iterations (--iterations {2 * done}, "
            f"or iterations={2 * done} in Python)"
        )
    _check_equal(run, learner, done)
    if learner.team.leads:
        note_changes(run, learner.env)
    try:
        learner.load_state_dict(content["state"])
        if learner.replay is not None:
            read_replay(run.replay, learner.replay, content["state"]["stored"], learner.own_worlds)
    except Exception as error:  # a damaged state may raise any error
        text = " ".join(str(error).split())
        raise ValueError(
            f"{run.checkpoint} does not fit the run's configuration: {text}; start a new run from its policy "
            f"(--from {run.folder})"
        ) from error


def _changed_versions(run: Run) -> dict[str, Any]:
    """Return the entry "resumed" of config.json if a version has changed, and log a warning."""
    now = versions(run.config["device"])
    then = run.config.get("versions", now)
    changed = {name: value for name, value in now.items() if then.get(name) != value}
    if not changed:
        return {}
    text = ", ".join(f"{name} {then.get(name)} then, {value} now" for name, value in changed.items())
    log.warning("versions have changed, so numbers may differ from an uninterrupted run's: %s", text)
    return {"resumed": [*run.config.get("resumed", []), changed]}


def _check_equal(run: Run, learner: Learner, done: int) -> None:
    """Check that a learner has the settings of a run. Its device, threads and processes may differ."""
    before, after = _fixed_settings(run.config), _fixed_settings(json.loads(json.dumps(describe(learner))))
    before["task"], after["task"] = run.manifest.get("name", learner.env.task.name), learner.env.task.name
    for name, copy in table_copies(run).items():  # ``note_changes`` reports a changed table
        if after.get(f"params.{name}") == str(copy):
            after[f"params.{name}"] = run.config["params"][name]
        elif after.get(f"params.{name}") == f"{name}.npy" and not np.array_equal(
            table := learner.env.task.params[name], np.load(copy).astype(table.dtype)
        ):
            raise ValueError(
                f"{copy} is another table than the given {name}, and a run keeps its settings: omit {name}, or start a "
                "new run in another folder"
            )
    if task_physics(learner.env)[1] == EXACT and (run.config.get("exact_from") or math.inf) <= done:
        before = {name: value for name, value in before.items() if not name.startswith("physics.")}
    for name in before | after:
        value, other = before.get(name), after.get(name)
        # this release may have hyperparameters that an older run lacks
        if value != other and (name in before or not name.startswith(f"{learner.algorithm}.")):
            raise ValueError(
                f"{run.folder / 'config.json'} has {name} {value}, not {other}, and a run keeps its settings: omit "
                f"{name.rpartition('.')[2]}, or start a new run in another folder"
            )


def _fixed_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a configuration that a run keeps, by their names in config.json."""
    settings = {name: config.get(name) for name in ("task", "algorithm", "nworld", "seed", "network")}
    settings["engine"] = engine_name(config.get("engine", ""), config.get("device"))
    for name in ("horizon", "fields", "dynamics", "objects"):
        settings[name] = config.get("options", {}).get(name)
    for part in ("physics", "params", str(config.get("algorithm"))):
        settings |= {f"{part}.{name}": value for name, value in config.get(part, {}).items()}
    return settings
