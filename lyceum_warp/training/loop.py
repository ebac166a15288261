"""Train a learner and write its run folder, as ``lw.train`` and ``lyceum-warp train`` do."""

import contextlib
import functools
import json
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from lyceum_warp.algos import EXACT, Iteration, Learner, evaluation_seed, task_physics, transfer as judge_transfer
from lyceum_warp.engines import engine_name
from lyceum_warp.support.files import replaced
from lyceum_warp.support.interrupts import Interrupted, postponed
from lyceum_warp.support.validate import check_flag, check_kind, positive_number, whole_number
from lyceum_warp.support.versions import versions
from lyceum_warp.training.runs.configuration import Configuration, describe
from lyceum_warp.training.runs.folder import Run
from lyceum_warp.training.runs.lock import run_lock
from lyceum_warp.training.runs.replay_files import read_replay
from lyceum_warp.training.runs.saving import Saver
from lyceum_warp.training.runs.task_copy import note_changes, note_uncopied_data, task_copy
from lyceum_warp.viz import CameraChoice, TensorBoard, Videos, check_tensorboard, check_video, find_camera, one_line

log = logging.getLogger(__name__)

Callback = Callable[[Any], Any]
"""Function that is called with an iteration's statistics, an object of the algorithm's ``Iteration`` class."""


class Display:
    """Shows the progress of training. This base class shows nothing."""

    @contextlib.contextmanager
    def training(self, run: Run, learner: Learner, iterations: int) -> Iterator[None]:
        """Return a context manager that is active during training."""
        yield

    def __call__(self, iteration: Iteration) -> None:
        """Show a finished iteration."""

    def work(self, text: str, unit: str, done: int, total: int) -> None:
        """Show the progress of work between iterations, such as rendering a video."""


def train(
    learner: Learner,
    folder: str | Path,
    *,
    iterations: int = 100,
    callback: Callback | None = None,
    target_return: float | None = None,
    minutes: float | None = None,
    keep_every: int = 0,
    save_every: int = 0,
    tensorboard: bool = False,
    video_every: int = 0,
    camera: CameraChoice = None,
    transfer: bool | None = None,
    resume: bool = False,
    take_over: bool = False,
    entries: Mapping[str, Any] | None = None,
    display: Display | None = None,
) -> Run:
    """Train a learner, and write metrics, policies and checkpoints into a run folder, as ``lyceum-warp train`` does.

    ``lw.load(folder)`` returns the last policy, and ``lw.load(folder, which="best")`` the policy with the best return.
    Policies are compared by ``mean_return`` if the learner evaluates the mean policy. Otherwise they are compared by
    ``return_mean``, the return of episodes under the policy before the update.

    The policy and the complete state are saved at the start, at the end, and every 30 s. Fast saves happen more often
    (``training/runs/saving.py``). A killed run resumes from the last save and produces the same numbers. After Ctrl-C,
    SIGTERM or SIGHUP, the run finishes the current iteration, is saved and ends. A second signal ends it at once.

    Args:
        learner: The algorithm, such as ``NPG(env)``, or another ``lyceum_warp.algos.common.learner.Learner``.
        folder: The run's folder. It must be new or empty.
        iterations: Total number of iterations, including those before resuming.
        callback: Function that is called with each iteration, after the iteration's row was written. Training ends if
            it returns True. If it raises an error, the run is saved and the error is raised again.
        target_return: Training ends when the return that selects the best policy reaches this number.
        minutes: Time limit. Training ends before an iteration that would exceed it if the iteration took as long as the
            longest one so far, not counting the first one, which may compile kernels. The first iteration always runs.
        keep_every: Iterations between policies that are saved in numbered files, or 0 for none.
        save_every: Iterations between saves, or 0 to save by time.
        tensorboard: Whether to write the metrics for TensorBoard, too.
        video_every: Iterations between videos of the policy, such as ``videos/000100.mp4`` in the folder, or 0 for
            none. If a video fails, a warning is logged, and training continues without videos.
        camera: Camera of the videos: the name or index of a camera in the model, a ``viz.cameras.FreeCamera``, or
            "free" for MuJoCo's default camera.
        transfer: Whether to run ``lw.transfer`` at the end, and to write ``transfer.json`` into the folder. By default,
            slow comparisons are omitted. After training on a GPU, the default compares the policy's results on the Warp
            engine with those on the C engine. After training with physics other than "exact", it compares the results
            with those in "exact" physics. ``transfer=True`` always compares the two engines and all physics options of
            the task.
        resume: Whether to continue the run in the folder. Make the learner with the same arguments as before.
        take_over: Whether to continue a run that another process has locked, on this or another host. That process then
            ends at its next write.
        entries: More JSON entries for config.json.
        display: Shows the progress.

    Returns:
        The run; ``run.rows()`` returns its metrics.

    Raises:
        ValueError: The folder is not empty, an argument is out of range, the run does not fit the learner, or another
            process has locked the run.
        ImportError: ``tensorboard`` needs the extra ``tensorboard``.
        NoVideoError: ``video_every`` needs the extra ``viz``.
        OSError: The folder cannot be written. The run can later be resumed from its last save.
        FloatingPointError: An update of the learner is not finite.
        Interrupted: One of several ranks received a signal.
    """
    check_kind("learner", learner, Learner, "as lw.NPG(env)")
    check_kind("folder", folder, str | Path, "as 'runs/mine'")
    check_kind("callback", callback, Callable | None, "a function")
    check_kind("entries", entries, Mapping | None, "as {'note': 'first try'}")
    check_kind("display", display, Display | None, "a Display of lyceum_warp.training.loop")
    check_flag("resume", resume)
    check_flag("take_over", take_over)
    check_flag("tensorboard", tensorboard)
    if transfer is not None:
        check_flag("transfer", transfer)
    if target_return is not None and (not isinstance(target_return, (int, float)) or math.isnan(target_return)):
        raise ValueError(f"target_return must be a number, not {target_return!r}")
    limit = math.inf if minutes is None else 60 * positive_number("minutes", minutes, "minutes")
    settings: dict[str, Any] = {
        "iterations": whole_number("iterations", iterations, low=1),
        "target_return": None if target_return is None else float(target_return),
        "keep_every": whole_number("keep_every", keep_every, low=0),
        "save_every": whole_number("save_every", save_every, low=0),
        "tensorboard": tensorboard,
        "video_every": whole_number("video_every", video_every, low=0),
    }
    env, leads, display = learner.env, learner.team.leads, display or Display()
    with contextlib.ExitStack() as shown:
        with learner.team.together():
            if tensorboard:
                check_tensorboard()
            if video_every:
                check_video()
            find_camera(env.model, camera)
            if resume:
                run = Run.open(folder)
            else:
                run = Run(Path(folder), describe(learner) | settings | dict(entries or {}))
                if leads:
                    kept, files = task_copy(env)
                    run = Run.create(folder, run.config | {"kept": kept}, files=files)
                    note_uncopied_data(env)
            if leads:
                run.check = shown.enter_context(run_lock(run.folder, take_over=take_over))
            if resume:
                _load_checkpoint(run, learner, settings)
        saved = learner.iteration if resume else -1
        saver = Saver(run if leads else None, learner, keep_every=keep_every, save_every=save_every, saved=saved)
        callbacks: list[Callback] = []
        if leads:
            board = shown.enter_context(TensorBoard(run.folder, env)) if tensorboard else None
            seed = evaluation_seed(env.options.seed + 1)
            folder = run.folder / "videos"
            videos = Videos(learner, folder, video_every, seed, camera=camera, progress=display.work)
            shown.enter_context(display.training(run, learner, iterations))
            callbacks = [function for function in (board, display, videos, callback) if function is not None]
        try:
            _learn(learner, saver, iterations, callbacks, target_return, limit)
        except Exception as error:
            if leads and saver.saved >= 0:
                error.add_note(f"the run in {run.folder} is saved up to iteration {saver.saved}")
            raise
        if leads:
            _judge_transfer(run, learner, transfer, display)
    return run


_PAIRS = 64
"""Number of episodes in the comparison at the end of training. Each episode runs under both settings."""


def _judge_transfer(run: Run, learner: Learner, wanted: bool | None, display: Display) -> None:
    env, exact = learner.env, task_physics(learner.env)[1] == EXACT
    on_gpu = env.device.is_cuda and env.engine.name == "warp"
    if wanted is False or (wanted is None and exact and not on_gpu):
        return
    progress = functools.partial(display.work, "judging the policy's transfer", "steps")
    try:
        found = judge_transfer(
            env, learner.policy, _PAIRS, seed=env.options.seed + 1, warp=on_gpu or wanted is True,
            physics=wanted is True, progress=progress,
        )  # fmt: skip
    except Exception as error:  # an error must not discard the training
        log.warning("no verdict on transfer (%s)", one_line(error))
        return
    with replaced(run.transfer) as temporary:
        temporary.write_text(json.dumps({"iteration": learner.iteration, **found.to_dict()}, indent=2))


def _learn(
    learner: Learner, saver: Saver, iterations: int, callbacks: list[Callback], target_return: float | None,
    limit: float,
) -> None:  # fmt: skip
    """Iterate until the target return, the last iteration or the time limit. All ranks stop together."""
    team, run, deadline, first = learner.team, saver.run, time.monotonic() + limit, learner.iteration + 1
    ended, longest = False, 0.0
    with postponed(insist=team.size == 1) as noted:
        if saver.saved != learner.iteration:
            saver.save()
        while learner.iteration < iterations and not ended:
            begin = time.monotonic()
            iteration, error = next(learner), None
            with team.together():
                if run is not None:
                    score = saver.write(iteration)
                    if target_return is not None and score is not None and score >= target_return:
                        run.amend(reached={"iteration": iteration.iteration, "return": score})
                        ended = True
            try:
                for function in callbacks:
                    ended = function(iteration) is True or ended
            except Exception as raised:
                error = raised
            now = time.monotonic()
            longest = now - begin if learner.iteration <= first + 1 else max(longest, now - begin)
            ended = ended or error is not None or learner.iteration >= iterations or now + longest > deadline
            numbers = max(noted, default=0), ended, error is not None, saver.due()
            signal, last, failed, due = team.largest(*map(int, numbers))
            if signal or last or due:
                saver.save()
            if error is not None:
                raise error
            if failed:
                raise SystemExit(2)
            if signal and team.size > 1:
                raise Interrupted(signal)
            ended = bool(last or signal)


def _load_checkpoint(run: Run, learner: Learner, settings: dict[str, Any]) -> None:
    folder, content = run.folder, run.read(learner.env.obs.device)
    reached, target, done = run.config.get("reached"), settings["target_return"], content["iteration"]
    if reached is not None and target is not None and reached["return"] >= target:
        raise ValueError(
            f"the run in {folder} is finished, because its return reached {reached['return']:.6g} in iteration "
            f"{reached['iteration']}: use a larger target return, or inf for none"
        )
    if settings["iterations"] <= done:
        raise ValueError(
            f"the run in {folder} already has {done} iterations: ask for more iterations (--iterations {2 * done}, or "
            f"iterations={2 * done} in Python)"
        )
    _check_equal(run, learner)
    if learner.team.leads:
        note_changes(run, learner.env)
    try:
        learner.load_state_dict(content["state"])
        if learner.replay is not None:
            read_replay(run.replay, learner.replay, content["state"]["stored"], learner.own_worlds)
    except Exception as error:  # a damaged state may raise any error
        text = " ".join(str(error).split())
        raise ValueError(f"{run.checkpoint} does not fit the run's configuration: {text}") from error
    if learner.team.leads:
        run.cut(done)  # a killed run may have unsaved rows
        now = versions(run.config["device"])
        then = run.config.get("versions", now)
        if changed := {name: value for name, value in now.items() if then.get(name) != value}:
            text = ", ".join(f"{name} {then.get(name)} then, {value} now" for name, value in changed.items())
            log.warning("versions have changed, so numbers may differ from an uninterrupted run's: %s", text)
            settings = settings | {"resumed": [*run.config.get("resumed", []), changed]}
        run.amend(**settings)


def _check_equal(run: Run, learner: Learner) -> None:
    then, now, env = Configuration.of(run), describe(learner), learner.env
    old, new, algorithm = then.options, env.options, run.config["algorithm"]
    now["engine"] = engine_name(now["engine"], now["device"])
    own = {"engine": engine_name(old.engine, old.device), "algorithm": algorithm, "nworld": old.nworld}
    # horizon, fields and dynamics may differ
    options = {"horizon": old.horizon, "fields": old.fields, "dynamics": old.dynamics}
    params = dict.fromkeys(now["params"]) | dict(then.params)
    # a table's file may have changed, and ``note_changes`` reports it
    params |= {name: value for name, value in now["params"].items() if value == run.config["params"].get(name)}
    hyperparameters = run.config.get(algorithm, {}), json.loads(json.dumps(learner.settings()))
    for before, after in (
        ({"task": run.config.get("kept", {}).get("name", env.task.name)}, {"task": env.task.name}),
        (own, now), (options, vars(new)), (vars(old.physics), vars(new.physics)), (params, now["params"]),
        hyperparameters,
    ):  # fmt: skip
        for name, value in before.items():
            if value != after.get(name):
                raise ValueError(
                    f"{run.folder / 'config.json'} has {name} {value}, not {after.get(name)}, and a run keeps its "
                    f"settings: omit {name}, or start a new run in another folder"
                )
