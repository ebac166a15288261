"""Training with a run's folder: the loop that the command line and ``lw.train`` share."""

import json
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from lyceum_warp.algos.evaluation import evaluation_seed
from lyceum_warp.algos.learner import Learner, LearnerIteration
from lyceum_warp.binding.registry import spelled_task
from lyceum_warp.engines.placement import engine_name
from lyceum_warp.env import Env
from lyceum_warp.interrupts import Interrupted, ending, postponed
from lyceum_warp.keeper import Keeper, NotSavedError
from lyceum_warp.kept_task import KeptTask, given_params, note_changes
from lyceum_warp.runs import Run
from lyceum_warp.tensorboard import TensorBoard, check_tensorboard
from lyceum_warp.validate import check_flag, check_function, check_kind, whole_number
from lyceum_warp.viz.cameras import CameraChoice, find_camera
from lyceum_warp.viz.policy_videos import Videos
from lyceum_warp.viz.video import check_video

Callback = Callable[[Any], Any]
"""Called with the statistics of each iteration, which are of the algorithm's own class."""


def train(
    learner: Learner,
    folder: str | Path,
    *,
    iterations: int = 100,
    callback: Callback | None = None,
    target_return: float | None = None,
    keep_every: int = 0,
    save_every: int = 0,
    tensorboard: bool = False,
    video_every: int = 0,
    camera: CameraChoice = None,
    resume: bool = False,
) -> Run:
    """Train, and write the same folder as ``lyceum-warp train``: metrics, policies and checkpoints.

    ``lw.load(folder)`` returns the last policy, ``lw.load(folder, which="best")`` the one with the best return:
    the mean policy's where the configuration has it evaluated (``mean_every``), otherwise the mean return of the
    episodes that ended in an iteration, which were sampled with the policy before it.

    The policy and the value function are saved after every iteration; where iterations take less than about a second,
    whenever training has taken 200 times as long as the last such save. The complete state, from which a run continues
    exactly, is larger. It is saved at the start, at the end, after an error or a signal, and whenever training has
    taken 400 times as long as the last such save, or every ``save_every`` iterations. A run that is killed continues
    from the last one, to the same numbers.

    Args:
        learner: The algorithm: ``NPG(env)``, or another ``lyceum_warp.algos.learner.Learner``.
        folder: The run's folder, new or empty.
        iterations: Iterations in all, including those before ``resume``.
        callback: Called with each iteration after it was saved. Training ends where it returns True, and where it
            raises an error, which is passed on.
        target_return: Training ends once the mean policy's return, or, without its evaluation, ``return_mean``, is at
            least this.
        keep_every: Iterations between two policies that are kept under their numbers; 0 for none.
        save_every: Iterations between two saves of the complete state; 0 for a number that follows from their time.
        tensorboard: Whether to write the metrics for TensorBoard, too.
        video_every: Iterations between two videos of the mean policy, ``videos/000100.mp4`` and so on in the folder,
            which TensorBoard shows, too; 0 for none. Where one fails, a warning says so, and training goes on.
        camera: Camera of the videos: one of the model's by name or index, a ``viz.cameras.FreeCamera``, or "free" for
            MuJoCo's default free camera.
        resume: Whether the folder holds a run that is continued; ``learner`` must be made with the same arguments.

    Returns:
        The run. ``run.rows()`` returns the metrics.

    Raises:
        ValueError: The folder holds something else, an argument is out of range, or the run does not fit
            ``learner``.
        ImportError: The extra ``tensorboard`` is not installed.
        NoVideoError: The extra ``viz`` is not installed, and there should be videos.
        NotSavedError: The folder could no longer be written; the message says where the run was saved instead.
        FloatingPointError: Ten iterations in a row had an update that is not finite; see ``NPG``. Other
            algorithms say when they raise it.
        Interrupted: One of several processes received a signal.
    """
    check_kind("learner", learner, Learner, "as lw.NPG(env)")
    check_kind("folder", folder, str | Path, "as 'runs/mine'")
    check_function("callback", callback)
    check_flag("resume", resume)
    check_flag("tensorboard", tensorboard)
    iterations = whole_number("iterations", iterations, low=1)
    settings = checked_settings(target_return=target_return, keep_every=keep_every, save_every=save_every)
    team, folder = learner.team, Path(folder)
    shown = {"tensorboard": tensorboard, "video_every": whole_number("video_every", video_every, low=0)}
    config = describe(learner) | {"iterations": iterations, **settings, **shown}
    with team.together():
        if tensorboard:
            check_tensorboard()
        if video_every:
            check_video()
            find_camera(learner.env.model, camera)
        if resume:
            run = Run.open(folder)
            content = run.read()
            check_resumable(run, content, iterations, target_return)
            _check_equal(run, config, learner.env)
            if team.leads:
                note_changes(run, learner.env)
            restore(run, learner, content)
        elif team.leads:
            kept = KeptTask.of(learner.env)
            run = Run.create(folder, config | kept.config, device=learner.env.options.device or "cpu")
            kept.write(run)
        else:
            run = Run(folder, config)
    if resume and team.leads:
        reopen(run, learner, iterations=iterations, **settings, **shown)
    board = TensorBoard(folder, run.config) if tensorboard and team.leads else None
    seed = evaluation_seed(learner.env.options.seed + 1)
    videos = Videos(learner, run.folder / "videos", video_every, seed, board, camera=camera)

    def after(iteration: LearnerIteration) -> Any:
        videos(iteration)
        return None if callback is None else callback(iteration)

    with ending():
        learn(
            run if team.leads else None, learner, iterations=iterations, callback=after, board=board, resumed=resume,
            **settings,
        )  # fmt: skip
    return run


def checked_settings(*, target_return: float | None = None, keep_every: int = 0, save_every: int = 0) -> dict[str, Any]:
    """The settings of a run that do not change its numbers, as config.json holds them.

    Raises:
        ValueError: A value is out of range.
    """
    if target_return is not None and (not isinstance(target_return, (int, float)) or math.isnan(target_return)):
        raise ValueError(f"target_return must be a number, not {target_return!r}")
    return {
        "target_return": None if target_return is None else float(target_return),
        "keep_every": whole_number("keep_every", keep_every, low=0),
        "save_every": whole_number("save_every", save_every, low=0),
    }


def describe(learner: Learner) -> dict[str, Any]:
    """The configuration of a run that an algorithm stands for, as config.json holds it."""
    env, options = learner.env, learner.env.options
    others = {name: value for name, value in options.given().items() if name in ("nthread", "horizon", "graphs")}
    others |= {name: list(names) for name in ("fields", "dynamics") if (names := getattr(options, name))}
    if isinstance(options.model, str | Path):
        others["model"] = str(Path(options.model).absolute()) if Path(options.model).is_file() else str(options.model)
    seed = {} if learner.seed == options.seed else {f"{learner.algorithm}_seed": learner.seed}
    return {
        "algorithm": learner.algorithm,
        "task": spelled_task(env.task.task),
        "params": given_params(env),
        "physics": options.physics.given(),
        "engine": options.engine if isinstance(options.engine, str) else env.engine.name,
        "device": options.device or "cpu",
        "options": others,
        "nworld": env.nworld * learner.team.size,
        "threads": torch.get_num_threads(),
        "seed": options.seed,
        **seed,
        learner.algorithm: learner.settings(),
    }


# continuing


def check_resumable(
    run: Run, content: Mapping[str, Any], iterations: int, target_return: float | None, *, command: bool = False
) -> None:
    """Refuse to continue a run that is finished.

    Args:
        run: The run.
        content: The content of its checkpoint.
        iterations: Iterations in all.
        target_return: The return at which it will end.
        command: Whether the message names a flag of the command line rather than an argument of ``train``.

    Raises:
        ValueError: The run has as many iterations, or has reached the return.
    """
    reached = run.config.get("reached")
    if reached is not None and target_return is not None and reached["return"] >= target_return:
        raise ValueError(
            f"the run in {run.folder} is finished: its return reached {reached['return']:.6g} in iteration "
            f"{reached['iteration']}: give a target return above that, or inf for none"
        )
    done = content["iteration"]
    if iterations <= done:
        more = f"--iterations {2 * done}" if command else f"iterations={2 * done}"
        raise ValueError(f"the run in {run.folder} already has {done} iterations: give more, as in {more}")


def _check_equal(run: Run, config: Mapping[str, Any], env: Env) -> None:
    """Refuse an algorithm with other settings than the run's."""
    now = json.loads(json.dumps(config))  # lists in place of tuples
    engine, engine_now = (engine_name(c["engine"], c["device"]) for c in (run.config, now))
    task = run.config.get("kept", {}).get("name", env.task.name)  # an older run lacks it
    names = [("task", task, env.task.name), ("engine", engine, engine_now)]
    names.append(("algorithm", run.config.get("algorithm"), now["algorithm"]))
    parts = ("params", "physics", now["algorithm"], "nworld")
    entries = [_entries(part, run.config.get(part), now[part]) for part in parts]
    options = _entries("options", run.config.get("options", {}), now["options"])
    others = [entry for entry in options if entry[0] not in _FREE_OPTIONS]
    for part in (names, *entries, others):
        for name, then, given in part:
            if then != given:
                raise ValueError(
                    f"the run in {run.folder} has {name} {then}, not {given}, and a run keeps its settings: make "
                    "the algorithm with the same arguments, or give another folder"
                )


def _entries(name: str, then: Any, now: Any) -> list[tuple[str, Any, Any]]:
    """Two values of a configuration's entry; for a table those of its entries that are known."""
    if not isinstance(then, Mapping):
        return [(name, then, now)]
    # an older run lacks the newest hyperparameters
    known = {**then, **now} if name in ("params", "physics", "options") else then
    return [(entry, then.get(entry), now.get(entry)) for entry in known]


_FREE_OPTIONS = ("nthread", "graphs", "model")
"""Options that do not change a run's numbers, and the model, which is compared by its content."""


def restore(run: Run, learner: Learner, content: Mapping[str, Any]) -> None:
    """Put an algorithm into the state of a run's checkpoint.

    Args:
        run: The run.
        learner: The algorithm.
        content: The content of the checkpoint.

    Raises:
        ValueError: The checkpoint does not fit the algorithm.
    """
    try:
        learner.load_state_dict(_on(learner.env.obs.device, content["state"]))
    except (KeyError, RuntimeError, ValueError) as error:
        raise ValueError(
            f"{run.checkpoint} does not fit the configuration beside it: {' '.join(str(error).split())}"
        ) from error


def _on(device: torch.device, state: Any) -> Any:
    """A state with all its tensors on a device."""
    if isinstance(state, torch.Tensor):
        return state.to(device)
    if isinstance(state, Mapping):
        return {name: _on(device, part) for name, part in state.items()}
    return [_on(device, part) for part in state] if isinstance(state, list) else state


def reopen(run: Run, learner: Learner, **settings: Any) -> None:
    """Cut a run's table to the iterations of its checkpoint, and note new settings."""
    run.cut(learner.iteration)
    run.amend(**settings)


# the loop


def learn(
    run: Run | None,
    learner: Learner,
    *,
    iterations: int,
    callback: Callback | None = None,
    target_return: float | None = None,
    keep_every: int = 0,
    save_every: int = 0,
    board: Any = None,
    resumed: bool = False,
) -> None:
    """Iterate, and write a run's files.

    Of several processes one has the run. When another one receives a signal, all of them finish the iteration and end
    together: they would wait endlessly for a process that ended within the iteration.

    Args:
        run: The run; None in processes that do not write.
        learner: The algorithm.
        iterations: Iterations in all.
        callback: Called with each iteration after it was saved; see ``train``.
        target_return: The return at which training ends.
        keep_every: Iterations between two numbered policies; 0 for none.
        save_every: Iterations between two complete states; 0 for a number that follows from their time.
        board: TensorBoard's writer.
        resumed: Whether the run holds the algorithm's present state.

    Raises:
        NotSavedError: The folder could no longer be written.
        Interrupted: One of several processes received a signal.
    """
    alone = learner.team.size == 1
    keeper = None if run is None else Keeper(
        run, learner, keep_every=keep_every, save_every=save_every, resumed=resumed
    )  # fmt: skip
    loop = None
    try:
        with postponed(not alone) as noted:
            loop = _Loop(keeper, learner, noted, [board, callback], target_return, resumed=resumed)
            loop.save()
            while learner.iteration < iterations and not loop.ended:
                loop.step()
            loop.save()
    except BaseException as error:
        if alone and keeper is not None and not isinstance(error, NotSavedError):
            with postponed():
                if loop is not None and not loop.iterating:
                    keeper.take(learner.state_dict())
                keeper.save_boundary()
            if isinstance(error, Exception):
                error.add_note(f"the run in {keeper.run.folder} is saved up to iteration {keeper.iteration}")
        raise
    finally:
        if board is not None:
            board.close()


class _Loop:
    """The order of a run's iterations, and the decisions that all processes make together.

    Args:
        keeper: Writes the files; None in processes that do not.
        learner: The algorithm.
        noted: Signals that this process received and postponed.
        callbacks: Called with each iteration; some may be None.
        target_return: The return at which training ends.
        resumed: Whether the run holds the algorithm's present state.
    """

    def __init__(
        self, keeper: Keeper | None, learner: Learner, noted: list[int], callbacks: list[Callback | None],
        target_return: float | None, *, resumed: bool,
    ) -> None:  # fmt: skip
        self.keeper, self.learner, self.noted, self.target_return = keeper, learner, noted, target_return
        self.callbacks = [function for function in callbacks if function is not None]
        self.alone = learner.team.size == 1
        self.due = self.ended = self.iterating = False
        self.saved = learner.iteration if resumed else -1
        self.error: Exception | None = None

    def step(self) -> None:
        """Make an iteration, keep it, and decide whether it was the last."""
        complete = self.due
        self.iterating = True
        iteration = next(self.learner)
        # a signal counts either before the iteration or after its row, so that the table and the state agree
        with postponed(self.alone):
            start = time.perf_counter()
            renewed = complete or (self.keeper is not None and self.keeper.policy_due())
            # the worlds of several processes are brought together only to be saved
            state = self.learner.state_dict() if complete or (renewed and self.alone) else None
            self._write(lambda keeper: keeper.keep(iteration, state, renewed=renewed, start=start))
            self.iterating = False
        if complete:
            self._write_state()
        self._decide(iteration)
        self._agree()

    def save(self) -> None:
        """Save the complete state, unless it is saved."""
        if self.saved < self.learner.iteration:
            state = self.learner.state_dict()
            self._write(lambda keeper: keeper.take(state))
            self._write_state()
            self._agree()

    def _write_state(self) -> None:
        self.saved = self.learner.iteration
        self._write(lambda keeper: keeper.save_boundary())

    def _write(self, action: Callable[[Keeper], None]) -> None:
        """Write files in the process that has the run; an error waits until all processes know of it."""
        if self.keeper is None or self.error is not None:
            return
        with postponed(self.alone):
            try:
                self.keeper.guarded(action, between=self.alone)
            except Exception as error:
                self.error = error

    def _decide(self, iteration: LearnerIteration) -> None:
        """Call the callbacks, and compare with the return at which training ends."""
        if self.keeper is None or self.error is not None:
            return
        try:
            for function in self.callbacks:
                self.ended = function(iteration) is True or self.ended
        except Exception as error:
            self.error = error
        reached = self.keeper.return_of(iteration)
        if self.target_return is not None and reached is not None and reached >= self.target_return:
            self._write(lambda keeper: keeper.note_target(iteration, reached))
            self.ended = True

    def _agree(self) -> None:
        """Bring the processes to the same decisions, and raise what one of them met."""
        due = self.keeper is not None and self.keeper.due()
        numbers = max(self.noted, default=0), self.ended, self.error is not None, due
        signal, ended, failed, complete = self.learner.team.largest(*map(int, numbers))
        self.ended, self.due = bool(ended), bool(complete)
        if self.error is not None:
            raise self.error
        if failed:
            raise SystemExit(2)
        if signal:
            if self.saved < self.learner.iteration:
                self.save()
            raise Interrupted(signal)
