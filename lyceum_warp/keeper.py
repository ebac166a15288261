"""What is saved of a run and when, in its folder, or elsewhere where that cannot be written."""

import collections
import math
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lyceum_warp.algos.learner import Iteration, Learner
from lyceum_warp.checkpoints import PolicyContent, policy_content
from lyceum_warp.runs import Run

SHARE = 400
"""The complete state is saved once training has taken this many times as long as the last such save."""

POLICY_SHARE = 200
"""The same for the policy, and for the copy of the complete state that is kept in memory."""

KEPT_ROWS = 1000
"""Rows of the table that are kept in memory, for a folder in which it cannot be read any more."""


class NotSavedError(OSError):
    """A run's folder could not be written. The message says where the run was saved instead."""


class Keeper:
    """Writes a run's files after each iteration, and, where its folder cannot be written, the whole run elsewhere.

    It keeps the boundary: the state after the last complete iteration, or, where iterations are short, after an earlier
    one. The boundary moves whenever training has taken 200 times as long as the last such save, so that its saves take
    at most a 200th of the time. Whatever happens later, that state can be saved.

    Args:
        run: The run.
        learner: The algorithm.
        keep_every: Iterations between two numbered policies; 0 for none.
        save_every: Iterations between two complete states; 0 for a number that follows from their time.
        resumed: Whether the run holds the algorithm's present state.
    """

    iteration: int
    """Number of the boundary's iteration."""

    def __init__(
        self, run: Run, learner: Learner, *, keep_every: int = 0, save_every: int = 0, resumed: bool = False
    ) -> None:
        self.run, self.learner, self.keep_every, self.save_every = run, learner, keep_every, save_every
        self.iteration = learner.iteration
        self._content = self._latest = policy_content(learner.iteration, learner.policy, learner.value)
        self._state: dict[str, Any] | None = None
        self._saved = learner.iteration if resumed else -1
        self._complete: tuple[PolicyContent, dict[str, Any]] | None = None
        self._best = run.best_score()
        self._best_content: PolicyContent | None = None
        self._files = run.files()
        self._rows: collections.deque[dict[str, Any]] = collections.deque(maxlen=KEPT_ROWS)
        self._seconds = self._policy_seconds = 0.0
        self._when = self._policy_when = time.perf_counter()

    def policy_due(self) -> bool:
        """Whether this iteration's policy is to be saved, and a copy of the complete state to be kept."""
        if self.keep_every and self.learner.iteration % self.keep_every == 0:
            return True
        return time.perf_counter() - self._policy_when >= POLICY_SHARE * self._policy_seconds

    def due(self) -> bool:
        """Whether the next iteration's complete state is to be saved."""
        if self.save_every:
            return (self.learner.iteration + 1) % self.save_every == 0
        return time.perf_counter() - self._when >= SHARE * self._seconds

    def return_of(self, iteration: Iteration) -> float | None:
        """The return by which policies are compared, where the iteration has one."""
        number: float | None = getattr(iteration, self.learner.best_by)
        return None if number is None or not math.isfinite(number) else number

    @property
    def _by_mean(self) -> bool:
        return self.learner.best_by == "mean_return"

    def take(self, state: dict[str, Any]) -> None:
        """Make the algorithm's present state the boundary."""
        self.iteration = self.learner.iteration
        if self._content["iteration"] != self.iteration:
            self._content = policy_content(self.iteration, self.learner.policy, self.learner.value)
        self._state = state

    def keep(
        self,
        iteration: Iteration,
        state: dict[str, Any] | None,
        *,
        renewed: bool = True,
        start: float | None = None,
    ) -> None:
        """Write the row of an iteration, and its policy.

        Args:
            iteration: The iteration.
            state: The algorithm's state after it, where it may be saved.
            renewed: Whether the boundary moves to this iteration, and its policy is saved.
            start: When the copy of the state began (``time.perf_counter``).
        """
        start = time.perf_counter() if start is None else start
        self._rows.append(iteration.row())
        self.run.write(self._rows[-1])
        score = self.return_of(iteration)
        better = score is not None and (self._best is None or score > self._best[1])
        before = self._latest
        if renewed or better or not self._by_mean:
            self._latest = policy_content(self.learner.iteration, self.learner.policy, self.learner.value)
        if score is not None and better:
            # the iteration's own episodes were sampled with the policy before its step
            self._best_content = self._latest if self._by_mean else before
            self._best = self._best_content["iteration"], score
            self.run.save_best(self._best_content, self.learner.best_by, score)
        if not renewed:
            return
        self.iteration, self._state, self._content = self.learner.iteration, state, self._latest
        self.run.save_policy(self._content, number=bool(self.keep_every) and self.iteration % self.keep_every == 0)
        self._policy_when = time.perf_counter()
        self._policy_seconds = self._policy_when - start

    def note_target(self, iteration: Iteration, reached: float) -> None:
        """Note in the configuration that the run reached its return."""
        self.run.amend(reached={"iteration": iteration.iteration, "return": reached})

    def save_boundary(self) -> None:
        """Save the complete state at the boundary, unless it is saved."""
        if self._saved != self.iteration and self._state is not None:
            self.guarded(Keeper.save_state)

    def save_state(self) -> None:
        """Save the complete state at the boundary."""
        start = time.perf_counter()
        assert self._state is not None
        self.run.save_policy(self._content)
        self.run.save_state(self._content, self._state)
        # of several processes, this is all that can be saved elsewhere
        self._complete = None if self.learner.team.size == 1 else (self._content, self._state)
        self._saved, self._when = self.iteration, time.perf_counter()
        self._seconds = self._when - start

    # where the folder cannot be written

    def guarded(self, action: Callable[["Keeper"], None], *, between: bool = False) -> None:
        """Write files; if that fails, save the run elsewhere.

        Args:
            action: Writes the files.
            between: Whether the algorithm is between two iterations, so that its present state can be saved.

        Raises:
            NotSavedError: It failed.
        """
        try:
            action(self)
        except NotSavedError:
            raise
        except OSError as error:
            if between and self.iteration != self.learner.iteration:
                self.take(self.learner.state_dict())
            raise NotSavedError(self._rescued(error)) from error

    def _rescued(self, error: OSError) -> str:
        """Save the run elsewhere; returns the message."""
        folder = self.run.folder
        what = f"{error.strerror or error}: {error.filename}" if error.filename else str(error.strerror or error)
        text = f"the run in {folder} could not be saved after iteration {self.iteration} ({what})"
        places = [_free(folder.with_name(f"{folder.name}-rescued")), None]
        for whole in (True, False):
            for place in places:
                if (rescued := self._copied(place, whole=whole)) is None:
                    continue
                if whole:
                    what = "the whole run" if self._state is not None else f"the run up to iteration {self._saved}"
                    return f"{text}: {what} is in {rescued}; continue it with train --resume {rescued}, or resume=True"
                return f"{text}: its policy is in {rescued / 'policy.pt'}{self._left()}"
        return f"{text}, nor in another folder{self._left()}"

    def _left(self) -> str:
        """What the run's folder still holds."""
        if self._saved >= 0 and (self.run.checkpoint.is_file() or self.run.previous.is_file()):
            return f"; {self.run.folder} can be continued from iteration {self._saved}"
        return ""

    def _copied(self, folder: Path | None, *, whole: bool) -> Path | None:
        """Write the run, or its policy alone, into another folder; None where that fails."""
        made = None
        try:
            if folder is None:
                made = Path(tempfile.mkdtemp(prefix="lyceum-warp-"))
            else:
                folder.mkdir(parents=True)
                made = folder
            run = Run(made, self.run.config)
            run.amend()
            for name, content in self._files.items():
                path = made / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(content)
            self._write_table(run)
            if self._best_content is not None and self._best is not None:
                run.save_best(self._best_content, self.learner.best_by, self._best[1])
            run.save_policy(self._content)
            if whole:
                complete = self._complete if self._state is None else (self._content, self._state)
                if complete is None:
                    raise OSError("there is no complete state")
                run.save_state(*complete)
            return made
        except OSError:
            if made is not None:
                shutil.rmtree(made, ignore_errors=True)
            return None

    def _write_table(self, run: Run) -> None:
        """Complete the table in another folder, which holds the rows before this training."""
        try:
            table = self.run.metrics.read_bytes()
        except OSError:
            table = b""
        if run.metrics.exists() and len(table) < run.metrics.stat().st_size:
            table = b""  # it was cut off
        last: float = -1
        try:
            if table:
                run.metrics.write_bytes(table)
            run.cut(self.learner.iteration)
            last = max((row["iteration"] or 0 for row in (run.rows() if run.metrics.exists() else [])), default=-1)
        except (ValueError, KeyError):  # other content than a table
            run.metrics.write_bytes(self._files.get(run.metrics.name, b""))
        for row in self._rows:
            if row["iteration"] > last:
                run.write(row)


def _free(folder: Path) -> Path:
    """The folder, or one of a similar name that does not exist."""
    number = 2
    free = folder
    while free.exists():
        free, number = folder.with_name(f"{folder.name}-{number}"), number + 1
    return free
