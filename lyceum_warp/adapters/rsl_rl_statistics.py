"""Statistics of an iteration of rsl_rl's PPO."""

import dataclasses

from lyceum_warp.algos.learner import LearnerIteration
from lyceum_warp.docstrings import document_attributes

RECENT = 100
"""Episodes in the mean that rsl_rl prints as the mean reward."""


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class RslRlIteration(LearnerIteration):
    """Statistics of one iteration of rsl_rl's PPO.

    Numbers about episodes cover those that ended in the iteration; they are nan where none ended. The first episodes
    of the worlds, which may begin at a random step, do not count.
    """

    return_recent: float
    """Mean return of the last 100 episodes that ended, in this iteration or before; rsl_rl prints it as the mean
    reward."""
    learning_rate: float
    """Learning rate after the iteration."""
    surrogate_loss: float
    """Mean of the clipped surrogate loss over the mini-batches."""
    entropy: float
    """Mean entropy of the policy over the mini-batches."""
    value_loss: float
    """Mean of the value function's loss over the mini-batches."""
    time_update: float
    """Seconds of the update."""
