"""Run code beside training, such as videos and the transfer test."""

import functools
import json
import logging
from collections.abc import Mapping
from typing import Any

from lyceum_warp.algos import Iteration, Learner, evaluation_seed, transfer
from lyceum_warp.support.files import replace_text
from lyceum_warp.support.validate import whole_number
from lyceum_warp.training.runs.folder import Run
from lyceum_warp.viz import CameraChoice, NamedProgress, check_video, find_camera, one_line, policy_video

log = logging.getLogger(__name__)


class Callback:
    """Base class of callbacks for ``lw.train``. Every method is optional.

    A function of the iteration is a callback, too. With several processes, only rank 0 calls callbacks.

    Example:
        >>> class Log(lw.Callback):
        ...     def begin(self, run, learner, iterations):
        ...         self.file = (run.folder / "log.txt").open("a")
        ...
        ...     def __call__(self, iteration):
        ...         print(iteration.iteration, iteration.return_mean, file=self.file)
        ...
        ...     def close(self):
        ...         self.file.close()
    """

    settings: Mapping[str, Any] = {}
    """Entries for the run's config.json, as JSON values."""

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Prepare for training up to a number of iterations. A resumed learner has the state of the checkpoint.

        If this method raises an error, training does not begin: a new run's folder is deleted, and a resumed run stays
        as it was.
        """

    def __call__(self, iteration: Iteration) -> object:
        """Handle an iteration, whose row is already in metrics.csv. Training ends if the result is True.

        If this method raises an error, the run is saved, and the error is raised again.
        """

    def end(self, run: Run, learner: Learner) -> None:
        """Finish after the last iteration. This method is not called after an error or a signal."""

    def close(self) -> None:
        """Release what ``begin`` has opened. This method is called last, even after an error."""


class Videos(Callback):
    """Writes a video of the policy every few iterations, such as ``videos/000100.mp4`` in the run's folder.

    If a video fails, a warning is logged, and training continues without videos.

    Args:
        every: Iterations between videos.
        camera: The name or index of a camera in the model, a ``lyceum_warp.viz.FreeCamera``, or "free" for MuJoCo's
            default camera.
        progress: Called with a description of the work, its unit, the units done so far and their total number.

    Raises:
        ValueError: ``every`` is not a positive number, or the model has no such camera.
        NoVideoError: Videos need the extra ``viz``.
    """

    def __init__(self, every: int, *, camera: CameraChoice = None, progress: NamedProgress | None = None) -> None:
        check_video()
        self.every, self.camera, self.progress = whole_number("every", every, low=1), camera, progress
        self.settings = {"video_every": self.every}

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Check that the model has the camera."""
        find_camera(learner.env.model, self.camera)
        self._folder, self._learner, self._failed = run.folder / "videos", learner, False

    def __call__(self, iteration: Iteration) -> None:
        """Write a video after an iteration, if one is due."""
        if self._failed or iteration.iteration % self.every:
            return
        env, path = self._learner.env, self._folder / f"{iteration.iteration:06d}.mp4"
        seed = evaluation_seed(env.options.seed + 1)
        try:
            policy_video(env, self._learner.policy, path, seed, camera=self.camera, progress=self.progress)
        except Exception as error:  # an error of any kind must not end the training
            log.warning("no further videos (%s)", one_line(error))
            self._failed = True


class TransferTest(Callback):
    """Runs ``lw.transfer`` on 64 pairs of episodes at the end of training, and writes the run's ``transfer.json``.

    If the test fails, a warning is logged.

    Args:
        warp: As in ``lw.transfer``.
        progress: As in ``Videos``.
    """

    def __init__(self, *, warp: bool = True, progress: NamedProgress | None = None) -> None:
        self.warp, self.progress = warp, progress

    def end(self, run: Run, learner: Learner) -> None:
        """Run the test."""
        env = learner.env
        progress = self.progress and functools.partial(self.progress, "judging the policy's transfer", "steps")
        try:
            verdict = transfer(env, learner.policy, 64, seed=env.options.seed + 1, warp=self.warp, progress=progress)
        except Exception as error:  # an error must not discard the training
            log.warning("no verdict on transfer (%s)", one_line(error))
            return
        replace_text(run.transfer, json.dumps({"iteration": learner.iteration, **verdict.to_dict()}, indent=2))
