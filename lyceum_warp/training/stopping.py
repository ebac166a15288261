"""End training at a target return, or after a number of minutes."""

import math
import time

from lyceum_warp.algos import Iteration, Learner
from lyceum_warp.support.validate import positive_number
from lyceum_warp.training.callbacks import Callback
from lyceum_warp.training.runs.folder import Run


class TargetReturn(Callback):
    """Ends training when the return that selects the best policy reaches a number.

    The iteration and the return are stored in config.json. A later call of ``lw.train`` needs a larger number.

    Raises:
        ValueError: ``target`` is not a number, or the run has already reached it.
    """

    def __init__(self, target: float) -> None:
        if not isinstance(target, int | float) or math.isnan(target):
            raise ValueError(f"target must be a number, not {target!r}")
        self.target = float(target)
        self.settings = {"target_return": self.target}

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Check that the run has not reached the target."""
        self._run, self._name = run, learner.best_by
        reached = run.config.get("reached")
        if reached is not None and reached["return"] >= self.target:
            raise ValueError(
                f"the run in {run.folder} is finished, because its return reached {reached['return']:.6g} in iteration "
                f"{reached['iteration']}: use a larger target return, or inf for none"
            )

    def __call__(self, iteration: Iteration) -> bool:
        """Compare an iteration's return with the target."""
        score = getattr(iteration, self._name)
        if score is None or math.isnan(score) or score < self.target:
            return False
        self._run.amend(reached={"iteration": iteration.iteration, "return": score})
        return True


class Minutes(Callback):
    """Ends training before an iteration that would probably exceed a time limit.

    An iteration is expected to take as long as the longest one so far, not counting the first one, which may compile
    kernels. The first iteration always runs. Pass this callback last, so that it counts the time of all others.

    Raises:
        ValueError: ``minutes`` is not a positive number.
    """

    def __init__(self, minutes: float) -> None:
        self.limit = 60 * positive_number("minutes", minutes, "minutes")

    def begin(self, run: Run, learner: Learner, iterations: int) -> None:
        """Start the clock."""
        self._start = self._now = time.monotonic()
        self._longest = 0.0
        self._second = learner.iteration + 2

    def __call__(self, iteration: Iteration) -> bool:
        """Compare the time at the end of the next iteration with the limit."""
        before, self._now = self._now, time.monotonic()
        seconds = self._now - before
        self._longest = seconds if iteration.iteration <= self._second else max(seconds, self._longest)
        return self._now + self._longest > self._start + self.limit
