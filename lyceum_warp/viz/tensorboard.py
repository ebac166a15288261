"""Write curves of a run for TensorBoard, with the extra ``tensorboard``.

``metrics.csv`` holds the same numbers; the files written here are a copy for another viewer.
"""

import importlib.util
import math
import os
import time
from pathlib import Path
from typing import Any

from lyceum_warp.algos.learner import Iteration

EXTRA = "pip install 'lyceum-warp[tensorboard]'"
"""Command that installs the package for TensorBoard."""

_GROUPS = {
    "mean_": "mean_policy", "return_": "return", "value_": "value", "time_": "time", "metrics/": "metrics",
    "step_metrics/": "step_metrics",
}  # fmt: skip
"""Groups of curves, by the prefix of their columns in metrics.csv."""

_TAGS = {
    "iteration": "time/iteration", "samples": "time/samples", "samples_per_second": "time/samples_per_second",
    "length_mean": "episode/length", "terminal_reward": "episode/terminal_reward", "eval_mean": "episode/eval",
    "success": "episode/success", "faults": "episode/faults", "outliers": "episode/outliers", "std_mean": "policy/std",
    "skipped_updates": "policy/skipped_updates", "reward_mean": "return/reward",
    "explained_variance": "value/explained_variance",
}  # fmt: skip
"""Names of curves that cannot be derived from the columns."""


class TensorBoard:
    """Writes a run's iterations where TensorBoard reads them; the horizontal axis counts samples.

    Every number of an iteration is a curve, named by its group: return/, episode/, mean_policy/, policy/, value/, time/
    metrics/ and step_metrics/.

    In a folder that already holds curves, the curves continue: what they hold from the samples of the first new
    iteration on is replaced.

    Example:
        >>> with TensorBoard("runs/mine") as board:
        ...     for it in NPG(env):
        ...         board(it)

    Args:
        folder: The folder; it is made if it does not exist. ``tensorboard --logdir`` takes it, or one above it.

    Raises:
        ImportError: The package tensorboard is not installed.
    """

    def __init__(self, folder: str | Path) -> None:
        check_tensorboard()
        self._folder = Path(folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        self._file: Any = None

    def __enter__(self) -> "TensorBoard":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __call__(self, iteration: Iteration) -> None:
        """Add an iteration. Non-finite numbers, such as returns if no episode ended, are omitted."""
        from tensorboard.compat.proto.summary_pb2 import Summary

        values = []
        for column, number in iteration.row().items():
            if number is not None and math.isfinite(number):
                values.append(Summary.Value(tag=tag(column), simple_value=number))
        self._write(Summary(value=values), iteration.samples, replaced=iteration.samples)

    def close(self) -> None:
        """Close the file. A later iteration opens a new one."""
        if self._file is not None:
            file, self._file = self._file, None
            file.close()

    def _write(self, summary: Any, samples: int, *, replaced: int) -> None:
        from tensorboard.compat.proto.event_pb2 import Event

        if self._file is None:
            self._open(replaced)
        self._add(Event(step=samples, summary=summary))
        self._file.flush()

    def _open(self, replaced: int) -> None:
        """Open a file. Writers of torch and TensorBoard use a thread, which would hide a full disk."""
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from torch.utils.tensorboard import RecordWriter

        number = len(list(self._folder.glob("events.out.tfevents.*")))  # TensorBoard reads files in alphabetical order
        name = f"events.out.tfevents.{int(time.time()):010d}.{number:04d}.{os.getpid()}"
        self._file = RecordWriter((self._folder / name).open("xb"))
        self._add(Event(file_version="brain.Event:2"))
        if number:  # TensorBoard discards points of earlier files from this step on
            self._add(Event(step=replaced, session_log=SessionLog(status=SessionLog.START)))

    def _add(self, event: Any) -> None:
        event.wall_time = time.time()
        self._file.write(event.SerializeToString())


def check_tensorboard() -> None:
    """Check that the package for TensorBoard is installed.

    Raises:
        ImportError: The package tensorboard is not installed.
    """
    if importlib.util.find_spec("tensorboard") is None:
        raise ImportError(f"curves for TensorBoard need the package tensorboard: {EXTRA}")


def tag(column: str) -> str:
    """The name of the curve for a column of ``metrics.csv``."""
    if column in _TAGS:
        return _TAGS[column]
    for beginning, group in _GROUPS.items():
        if column.startswith(beginning):
            return f"{group}/{column.removeprefix(beginning)}"
    return f"policy/{column}"
