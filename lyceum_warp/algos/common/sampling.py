"""Define the base class of learners that sample worlds, with the statistics and the counters of their iterations."""

from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import torch

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.algos.common.evaluation import MeanPolicyEvaluation
from lyceum_warp.algos.common.learner import Learner
from lyceum_warp.algos.common.rollout_buffer import Rollout
from lyceum_warp.algos.common.rollout_statistics import SampledIteration
from lyceum_warp.algos.common.timing import PhaseTimer
from lyceum_warp.env.env import Env
from lyceum_warp.support.validate import check_kind

Statistics = TypeVar("Statistics", bound=SampledIteration)


class SamplingLearner(Learner):
    """Base class of NPG, PPO, SAC and Distill, which learn from the samples of the last iteration or of a replay."""

    config_type: ClassVar[type]
    """The class of ``config``."""
    generator: torch.Generator
    """Random generator of the noise."""
    rollout: Rollout
    """The samples of the last iteration."""
    count: int
    """Samples per iteration, over all processes."""

    def __init__(self, env: Env, config: Any, *, seed: int, team: Team | None) -> None:
        kind = self.config_type
        check_kind(f"config of {type(self).__name__}", config, kind | None, f"as lw.{kind.__name__}(hidden=(64, 64))")
        super().__init__(env, seed=seed, team=team)
        self.config = config or kind()
        self._evaluate_mean = MeanPolicyEvaluation(env, self.config, self.team)

    def _check_finite(self, update: dict[str, Any], inputs: str = "rewards and observations") -> None:
        """Check that an update is finite, and remove this number from the update's statistics."""
        if not update.pop("finite"):
            raise FloatingPointError(
                f"the update of iteration {self.iteration + 1} is not finite: make learning_rate, or the {inputs}, "
                f"smaller ({self.rollout.extremes()})"
            )

    def _finished(
        self, kind: type[Statistics], timer: PhaseTimer, statistics: Mapping[str, Any], *, rate_of: tuple[str, ...]
    ) -> Statistics:
        """Count an iteration, evaluate the mean policy if due, and return the iteration's statistics.

        ``rate_of`` names the phases whose time determines the number of samples per second.
        """
        self.iteration += 1
        self.samples += self.count
        results = self._evaluate_mean.added(statistics, self.policy, self.iteration)
        timer.mark("mean")
        results |= (times := timer.seconds())
        rate = self.count / sum(times[f"time_{phase}"] for phase in rate_of)
        return kind(iteration=self.iteration, samples=self.samples, samples_per_second=rate, **results)

    def state_dict(self) -> dict[str, Any]:
        """Copy the complete state; see ``Learner``."""
        return super().state_dict() | {"returns": self.team.gather(self.rollout.running_return).clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a result of ``state_dict``; see ``Learner``."""
        super().load_state_dict(state)
        self.rollout.running_return.copy_(state["returns"][self.own_worlds])
