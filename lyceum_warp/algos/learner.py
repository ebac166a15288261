"""What training needs of a learning algorithm, so that one loop and one kind of run folder serve every algorithm."""

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol, TypeVar, runtime_checkable

from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.docstrings import document_attributes
from lyceum_warp.env import Env

METRIC_COLUMN = "metrics/"
"""What the columns of a task's own metrics begin with."""


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class LearnerIteration:
    """What every algorithm's statistics of an iteration have. An algorithm's own statistics are a subclass."""

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
    faults: int
    """Faults of worlds in this iteration."""
    time_sample: float
    """Seconds of sampling."""
    time_mean: float
    """Seconds of evaluating the mean policy."""
    samples_per_second: float
    """Samples divided by the seconds of sampling."""
    metrics: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Means of the task's metrics, each summed over an episode, by the metrics' names."""

    def row(self) -> dict[str, Any]:
        """The numbers by the names of their columns in metrics.csv; the metric ``forward`` is ``metrics/forward``."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "metrics"]
        metrics = {METRIC_COLUMN + name: mean for name, mean in self.metrics.items()}
        return {name: getattr(self, name) for name in names} | metrics


class LearnerConfig(Protocol):
    """The hyperparameters of an algorithm, a dataclass."""

    @property
    def mean_every(self) -> int:
        """Iterations between two evaluations of the mean policy; 0 for never."""


@runtime_checkable
class Learner(Protocol):
    """A learning algorithm: each ``next`` makes an iteration, after which its state can be saved.

    ``lw.train`` trains any object that has these attributes and methods.
    """

    algorithm: str
    """Its name, which also names its hyperparameters in config.json."""
    env: Env
    """The environment in which it learns; its policy is evaluated in others of the same task."""
    team: Team
    """The processes that learn together."""
    policy: GaussianPolicy
    """The policy after the last iteration."""
    value: ValueFunction
    """The value function after the last iteration."""
    seed: int
    """Seed of new networks and of the noise."""
    iteration: int
    """Number of complete iterations."""
    samples: int
    """Samples in all iterations so far."""

    @property
    def config(self) -> LearnerConfig:
        """The hyperparameters."""

    def __next__(self) -> LearnerIteration:
        """Make an iteration: sample, update the policy, and evaluate it where it is time for that.

        Raises:
            FloatingPointError: An update is not finite, so that learning cannot go on.
        """

    def settings(self) -> dict[str, Any]:
        """The hyperparameters, with the sizes of the networks, as config.json holds them."""

    def state_dict(self) -> dict[str, Any]:
        """A copy of everything that the next iteration depends on: tensors, numbers, strings and containers of them."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken.

        Raises:
            ValueError: The state does not fit.
        """


Config = TypeVar("Config")


def fitted_config(config: Config, policy_shape: Mapping[str, Any], value_shape: Mapping[str, Any]) -> Config:
    """Hyperparameters with the sizes and the group of given networks, from which networks like these can be made.

    Args:
        config: The hyperparameters, a dataclass.
        policy_shape: The ``shape`` of the policy.
        value_shape: That of the value function.
    """
    assert dataclasses.is_dataclass(config) and not isinstance(config, type)
    entries = {"hidden": policy_shape.get("hidden"), "activation": policy_shape.get("activation")}
    entries |= {f"value_{name}": value_shape.get(name) for name in ("hidden", "activation")}
    entries |= {"normalize": policy_shape.get("normalize"), "time_orders": value_shape.get("time_orders")}
    if getattr(config, "value_group", None) is not None and value_shape:
        entries["value_group"] = value_shape.get("group", "policy")
    known = {field.name for field in dataclasses.fields(config)}
    changes = {name: entry for name, entry in entries.items() if entry is not None and name in known}
    return dataclasses.replace(config, **changes)
