"""Log runs for TensorBoard and to Weights & Biases, with the extras ``tensorboard`` and ``wandb``."""

import math
import os
import time
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lyceum_warp.algos import Iteration, Learner
from lyceum_warp.env import Env
from lyceum_warp.support.extras import check_extra
from lyceum_warp.support.mappings import flat_settings
from lyceum_warp.training.callbacks import Callback
from lyceum_warp.training.comparison import row_seconds
from lyceum_warp.training.runs.folder import Run

_GROUPS = {
    "mean_": "mean_policy", "return_": "return", "value_": "value", "time_": "time", "metrics/": "metrics",
    "step_metrics/": "Episode_Metrics",
}  # fmt: skip
"""Maps the prefix of a column in metrics.csv to the curve's group. mjlab also uses Episode_Metrics for means per
step."""

_NO_SETTINGS = ("format", "kept", "terms", "versions", "resumed", "reached", "passed")
"""Entries of config.json that are no settings."""

_TAGS = {
    # names that rsl_rl uses
    "return_mean": "Train/mean_reward", "length_mean": "Train/mean_episode_length", "std_mean": "Policy/mean_std",
    "value_loss": "Loss/value", "surrogate_loss": "Loss/surrogate", "entropy": "Loss/entropy", "loss": "Loss/behavior",
    "learning_rate": "Loss/learning_rate", "total_fps": "Perf/total_fps", "time_sample": "Perf/collection_time",
    "time_update": "Perf/learning_time",
    # columns whose group does not follow from a prefix in _GROUPS
    "iteration": "time/iteration", "samples": "time/samples", "samples_per_second": "time/samples_per_second",
    "terminal_reward": "episode/terminal_reward", "eval_mean": "episode/eval",
    "success": "episode/success", "faults": "episode/faults", "outliers": "episode/outliers",
    "skipped_updates": "policy/skipped_updates", "reward_mean": "return/reward",
    "explained_variance": "value/explained_variance",
}  # fmt: skip
"""Maps a column of metrics.csv to the curve's name."""


class TensorBoard(Callback):
    """Writes a run's iterations to files for TensorBoard. The horizontal axis counts iterations from 0.

    Every number of an iteration becomes a curve. Curves that rsl_rl or mjlab also write have the same names, units and
    axes, so that runs can be overlaid. These curves are in the groups Train/, Loss/, Policy/, Perf/, Episode_Metrics/
    and, if ``env`` is given, Episode_Reward/ and Episode_Termination/. All other curves are in the groups return/,
    episode/, mean_policy/, policy/, value/, time/ and metrics/.

    With ``lw.train``, the run's settings are shown as hyperparameters, and the videos of ``Videos``, which must come
    before this callback, as moving pictures.

    Existing curves in the folder are continued. Values from the first new iteration on are overwritten.

    Example:
        >>> lw.train(NPG(env), "runs/mine", callbacks=[lw.TensorBoard()])
        >>> with lw.TensorBoard("runs/own_loop") as board:
        ...     for it in NPG(env):
        ...         board(it)

    Args:
        folder: The folder, which need not exist. Pass this folder, or a parent folder, to ``tensorboard --logdir``.
            ``lw.train`` replaces it by the run's folder.
        env: The environment of the run; ``lw.train`` passes that of the learner. Episode_Reward/NAME is the sum of a
            reward term over an episode, divided by the time limit in seconds. Episode_Termination/NAME is the mean
            number of episodes that the function NAME ends per step of all worlds.

    Raises:
        ImportError: The package tensorboard is not installed.
    """

    settings: Mapping[str, Any] = {"tensorboard": True}

    def __init__(self, folder: str | Path = ".", env: Env | None = None) -> None:
        check_extra("TensorBoard", "tensorboard")
        self._folder = Path(folder)
        self._terms: dict[str, tuple[str, float]] = {} if env is None else _terms(env)
        self._file: Any = None
        self._settings: dict[str, Any] = {}

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Write into the run's folder."""
        self._folder, self._terms = run.folder, _terms(learner.env)
        self._settings = flat_settings({name: value for name, value in run.config.items() if name not in _NO_SETTINGS})

    def __enter__(self) -> "TensorBoard":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __call__(self, iteration: Iteration) -> None:
        """Add an iteration without its non-finite numbers. The return is NaN if no episode has ended."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        values = []
        for column, number in (_total_fps(iteration) | iteration.row()).items():
            if number is not None and math.isfinite(number):
                name, scale = self._terms.get(column, (tag(column), 1.0))
                values.append(Summary.Value(tag=name, simple_value=scale * number))
        step = iteration.iteration - 1
        if self._file is None:
            self._open(step)
        self._add(step=step, summary=Summary(value=values))
        if (video := self._folder / "videos" / f"{iteration.iteration:06d}.mp4").is_file():
            self._add(step=step, summary=_moving_picture(video))
        self._file.flush()

    def close(self) -> None:
        """Close the file. A later iteration opens a new file."""
        if self._file is not None:
            file, self._file = self._file, None
            file.close()

    def _open(self, step: int) -> None:
        """Open a file without torch's writer, whose thread would print a traceback if the disk is full."""
        from tensorboard.compat.proto.event_pb2 import SessionLog
        from torch.utils.tensorboard import RecordWriter

        self._folder.mkdir(parents=True, exist_ok=True)
        number = len(list(self._folder.glob("events.out.tfevents.*")))  # TensorBoard reads files in alphabetical order
        name = f"events.out.tfevents.{int(time.time()):010d}.{number:04d}.{os.getpid()}"
        self._file = RecordWriter((self._folder / name).open("xb"))
        self._add(file_version="brain.Event:2")
        # this event makes TensorBoard discard the points of earlier files from `step` on
        self._add(step=step, session_log=SessionLog(status=SessionLog.START))
        if self._settings:
            from torch.utils.tensorboard.summary import hparams

            values = {name: x if isinstance(x, bool | int | float) else str(x) for name, x in self._settings.items()}
            for summary in hparams(values, {tag("return_mean"): None, tag("mean_return"): None}):
                self._add(step=step, summary=summary)

    def _add(self, **event: Any) -> None:
        from tensorboard.compat.proto.event_pb2 import Event

        self._file.write(Event(wall_time=time.time(), **event).SerializeToString())


class WandB(Callback):
    """Logs a run's settings, curves and videos to Weights & Biases. A resumed run continues its page.

    The curves have the names that ``TensorBoard`` gives them. Pass this callback after ``Videos``.

    Args:
        project: The project.
        options: More arguments of ``wandb.init``, such as ``mode="offline"`` or ``group="five seeds"``.

    Raises:
        ImportError: The package wandb is not installed.
    """

    def __init__(self, project: str = "lyceum_warp", **options: Any) -> None:
        check_extra("Weights & Biases", "wandb")
        import wandb

        self._wandb = wandb
        self._options = {"project": project, **options}
        self.settings: dict[str, Any] = {"wandb": project}

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Open the run's page."""
        self._videos = run.folder / "videos"
        run.amend(wandb_id=run.config.get("wandb_id", uuid.uuid4().hex[:12]))
        config = {name: value for name, value in run.config.items() if name != "kept"}
        options = {"name": run.folder.name, "id": run.config["wandb_id"], "resume": "allow", **self._options}
        self._wandb.init(dir=run.folder, config=config, **options)

    def __call__(self, iteration: Iteration) -> None:
        """Log an iteration without its non-finite numbers."""
        numbers = {tag(name): x for name, x in iteration.row().items() if x is not None and math.isfinite(x)}
        if (video := self._videos / f"{iteration.iteration:06d}.mp4").is_file():
            numbers["video"] = self._wandb.Video(str(video), format="mp4")
        self._wandb.log(numbers, step=iteration.iteration)

    def close(self) -> None:
        """Close the run's page."""
        self._wandb.finish()


def _moving_picture(video: Path) -> Any:
    """Convert a video to an animated GIF, which TensorBoard shows as an image, with a third of the frames."""
    import imageio.v3
    from tensorboard.compat.proto.summary_pb2 import Summary

    frames = imageio.v3.imread(video)[::3, ::2, ::2]
    rate = imageio.v3.immeta(video)["fps"] / 3
    gif = imageio.v3.imwrite("<bytes>", frames, extension=".gif", duration=1000 / rate, loop=0)
    image = Summary.Image(height=frames.shape[1], width=frames.shape[2], colorspace=3, encoded_image_string=gif)
    return Summary(value=[Summary.Value(tag="video", image=image)])


def _terms(env: Env) -> dict[str, tuple[str, float]]:
    """Return mjlab's names for columns, each with a factor that converts to mjlab's unit."""
    task, seconds = env.task.definition, env.horizon * env.timestep
    rewards = task.rewards if seconds else ()  # mjlab divides rewards by the time limit
    return {f"metrics/{name}": (f"Episode_Reward/{name}", 1 / seconds) for name in rewards} | {
        f"step_metrics/{name}": (f"Episode_Termination/{name}", float(env.nworld))
        for name in (*task.terminations, *task.truncations)
    }


def _total_fps(iteration: Iteration) -> dict[str, float]:
    """Compute the samples per second, excluding the time of evaluations."""
    seconds = row_seconds(iteration.row())
    return {"total_fps": iteration.samples / iteration.iteration / seconds} if seconds else {}


def tag(column: str) -> str:
    """Return the name of the curve for a column of ``metrics.csv``."""
    if column in _TAGS:
        return _TAGS[column]
    for beginning, group in _GROUPS.items():
        if column.startswith(beginning):
            return f"{group}/{column.removeprefix(beginning)}"
    return f"policy/{column}"
