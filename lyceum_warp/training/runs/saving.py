"""Decide when to save a run, and save it."""

import math
import time
from typing import Any

from lyceum_warp.algos import Iteration, Learner
from lyceum_warp.env import Curriculum
from lyceum_warp.training.runs.checkpoints import policy_content, write_content
from lyceum_warp.training.runs.folder import Run
from lyceum_warp.training.runs.replay_files import clean_replay, write_replay


class Saver:
    """Writes a run's files.

    The saver writes metrics after each iteration. It also writes the policy if the policy is the best so far, or if
    ``keep_every`` requires a numbered file. The last policy and the complete state are saved together, usually every
    30 s. If a save takes less than 0.3 s, the next save follows after 100 times this duration. If a save takes more
    than 1.5 s, the next save follows after 20 times this duration. After ``kill -9``, the run resumes from the last
    save.

    All ranks have a saver and make the same calls. Ranks without a run do not write. ``lw.train`` describes
    ``keep_every`` and ``save_every``.
    """

    saved: int
    """Number of the last saved iteration; -1 before the first save."""

    def __init__(
        self,
        run: Run | None,
        learner: Learner,
        *,
        keep_every: int = 0,
        save_every: int = 0,
        saved: int = -1,
    ) -> None:
        self.run, self.learner = run, learner
        self.keep_every, self.save_every = keep_every, save_every
        self.saved = saved
        best = None if run is None else run.best_score()
        self._best = -math.inf if best is None else best[1]
        self._before = self._content()
        self._seconds, self._when = 0.0, time.perf_counter()
        self._stored = learner.replay.stored if learner.replay is not None and saved >= 0 else 0

    def write(self, iteration: Iteration) -> None:
        """Write an iteration's metrics, and its policy if it is the best so far or needs a numbered file."""
        learner, run, name = self.learner, self.run, self.learner.best_by
        if run is None:
            return
        run.check()
        run.append(iteration.row())
        score = getattr(iteration, name)
        better = score is not None and score > self._best  # a score may be NaN
        numbered = self.keep_every > 0 and learner.iteration % self.keep_every == 0
        # return_mean belongs to the policy that sampled the episodes, before the update
        sampled = name == "return_mean"
        before = self._before
        if better or numbered or sampled:
            self._before = self._content()
        if better:
            self._best = score
            content = before if sampled else self._before
            write_content(run.best, {**content, "score": {"name": name, "value": score}})
        if numbered:
            path = run.numbered(learner.iteration)
            path.parent.mkdir(exist_ok=True)
            write_content(path, self._before)

    def _content(self) -> dict[str, Any]:
        learner = self.learner
        return policy_content(learner.iteration, learner.policy, learner.value, Curriculum.of(learner.env))

    def due(self) -> bool:
        """Check whether it is time to save."""
        if self.save_every:
            return self.learner.iteration % self.save_every == 0
        wait = max(min(30.0, 100 * self._seconds), 20 * self._seconds)
        return time.perf_counter() - self._when >= wait

    def save(self) -> None:
        """Save the last policy and the complete state."""
        start = time.perf_counter()
        learner, run, replay = self.learner, self.run, self.learner.replay
        state = learner.state_dict()  # all ranks must call this, because it gathers their worlds
        if replay is not None:
            write_replay(run, replay, learner.team, self._stored)
        with learner.team.together():
            if run is not None:
                run.check()
                run.save(self._content(), state)
                if replay is not None:
                    clean_replay(run.replay, replay)
        self._stored = 0 if replay is None else replay.stored
        self.saved, self._when = learner.iteration, time.perf_counter()
        self._seconds = self._when - start
