"""Statistics of an iteration of rsl_rl's PPO."""

import dataclasses
from collections.abc import Mapping

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

    iteration: int
    """Number of the iteration, from 1."""
    samples: int
    """Samples in all iterations so far."""
    reward_mean: float
    """Mean reward of a step, over all samples."""
    return_mean: float
    """Mean return (sum of an episode's rewards) of the stochastic policy."""
    return_std: float
    """Standard deviation of these returns."""
    return_min: float
    """Smallest of these returns."""
    return_max: float
    """Largest of these returns."""
    return_recent: float
    """Mean return of the last 100 episodes that ended, in this iteration or before; rsl_rl prints it as the mean
    reward."""
    length_mean: float
    """Mean number of steps in an episode."""
    terminal_reward: float
    """Mean reward of an episode's last step."""
    eval_mean: float
    """Mean evaluation metric at the end of an episode."""
    success: float
    """Share of the episodes that ended with the goal met; nan for a task without a success."""
    mean_return: float | None
    """Mean return of the mean policy; None in iterations without an evaluation of it. Episodes of a task without a
    horizon are cut off after 1,000 steps."""
    mean_length: float | None
    """Mean number of steps in an episode of the mean policy, or None."""
    mean_terminal_reward: float | None
    """Mean reward of the last step of an episode of the mean policy, or None."""
    mean_eval: float | None
    """Mean evaluation metric at the end of an episode of the mean policy, or None."""
    mean_success: float | None
    """Share of the mean policy's episodes that ended with the goal met, or None; None for a task without a success."""
    kl: float
    """KL divergence from the old to the new policy, averaged over the samples."""
    std_mean: float
    """Mean standard deviation of the policy's actions."""
    learning_rate: float
    """Learning rate after the iteration."""
    surrogate_loss: float
    """Mean of the clipped surrogate loss over the mini-batches."""
    entropy: float
    """Mean entropy of the policy over the mini-batches."""
    value_loss: float
    """Mean of the value function's loss over the mini-batches."""
    faults: int
    """Faults of worlds in this iteration."""
    time_sample: float
    """Seconds of sampling."""
    time_update: float
    """Seconds of the update."""
    time_mean: float
    """Seconds of evaluating the mean policy."""
    samples_per_second: float
    """Samples divided by the seconds of sampling."""
    metrics: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Means of the task's metrics, each summed over an episode, by the metrics' names."""
