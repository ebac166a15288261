"""Define what training needs of a learning algorithm, so that one loop and one kind of run folder serve every one."""

import abc
import copy
import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import torch

from lyceum_warp.algos.distributed import Team
from lyceum_warp.env import Env
from lyceum_warp.support.docstrings import document_attributes
from lyceum_warp.support.validate import whole_number

METRIC_COLUMN = "metrics/"
"""What the columns of a task's own metrics begin with."""


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class Iteration:
    """Statistics of one iteration of a learner. Numbers that it does not report are None.

    An algorithm with further numbers puts them into ``numbers``, or extends this class by fields.
    """

    iteration: int
    """Number of the iteration, from 1."""
    samples: int
    """Samples in all iterations so far."""
    reward_mean: float | None = None
    """Mean reward of a step, over all samples."""
    return_mean: float | None = None
    """Mean return (sum of an episode's rewards) of the episodes that ended while sampling; nan if none ended."""
    return_std: float | None = None
    """Standard deviation of these returns."""
    return_min: float | None = None
    """Smallest of these returns."""
    return_max: float | None = None
    """Largest of these returns."""
    length_mean: float | None = None
    """Mean number of steps in an episode."""
    terminal_reward: float | None = None
    """Mean reward of an episode's last step."""
    eval_mean: float | None = None
    """Mean evaluation metric at the end of an episode."""
    success: float | None = None
    """Share of the episodes that ended with the goal met; nan for a task without a success."""
    mean_return: float | None = None
    """Mean return of the policy without noise, after the iteration; None in iterations that do not evaluate it."""
    mean_length: float | None = None
    """Mean number of steps in an episode of this evaluation, or None."""
    mean_terminal_reward: float | None = None
    """Mean reward of the last step of an episode of this evaluation, or None."""
    mean_eval: float | None = None
    """Mean evaluation metric at the end of an episode of this evaluation, or None."""
    mean_success: float | None = None
    """Share of these episodes that ended with the goal met, or None; None for a task without a success."""
    metrics: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Means of the task's metrics, each summed over an episode, by the metrics' names."""
    numbers: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Further numbers of the algorithm, by the names of their columns."""

    def row(self) -> dict[str, Any]:
        """The numbers by the names of their columns in metrics.csv, without those that are None.

        The metric ``forward`` is ``metrics/forward``.
        """
        names = [field.name for field in dataclasses.fields(self) if field.name not in ("metrics", "numbers")]
        own = {name: number for name in names if (number := getattr(self, name)) is not None}
        return own | dict(self.numbers) | {METRIC_COLUMN + name: mean for name, mean in self.metrics.items()}


@document_attributes
class Learner(abc.ABC):
    """A learning algorithm, which ``lw.train`` trains: an endless iterator that yields an ``Iteration`` each time.

    A learner of your own extends this class. It sets ``algorithm``, ``policy`` and ``config``, and defines
    ``__next__``, which counts ``iteration`` and ``samples``. What else the next iteration depends on is added to
    ``state_dict`` and ``load_state_dict``. docs/learners.md has an example.

    Args:
        env: The environment; do not step it between iterations.
        seed: Seed of new networks and of the noise.
        team: The processes that learn together, each with an environment of its share of the worlds; by default this
            process alone.

    Raises:
        ValueError: The environment does not reset automatically, or has other worlds than its share; or the seed is
            not a whole number.
    """

    algorithm: str
    """The name of the algorithm in a run's config.json, where its hyperparameters have this name, too."""
    env: Env
    """The environment in which it learns; its policy is evaluated in others of the same task."""
    policy: torch.nn.Module
    """The policy after the last iteration. Its method ``act`` maps observations, (..., nobs), to actions without noise,
    (..., nact); a normaliser of observations is part of it. Its attributes ``nobs`` and ``nact`` are these sizes."""
    value: torch.nn.Module | None = None
    """The value function after the last iteration, for algorithms that have one."""
    config: Any
    """The hyperparameters, a dataclass."""
    seed: int
    """Seed of new networks and of the noise."""
    team: Team
    """The processes that learn together."""
    generator: torch.Generator | None = None
    """The source of its random numbers, if it has one."""
    iteration: int
    """Number of complete iterations."""
    samples: int
    """Samples in all iterations so far."""

    def __init__(self, env: Env, *, seed: int = 0, team: Team | None = None) -> None:
        self.env, self.seed = env, whole_number("seed", seed, low=0)
        self.team = team = team or Team()
        self.iteration = self.samples = 0
        n = env.nworld
        self._own = slice(team.rank * n, (team.rank + 1) * n)
        if team.size > 1 and env.first_world != self._own.start:
            raise ValueError(
                f"process {team.rank} of {team.size} with {n} worlds needs an environment with "
                f"first_world={self._own.start}, not {env.first_world}"
            )
        if not env.autoreset:
            raise ValueError(
                f"{type(self).__name__} needs an environment that resets automatically: make it with autoreset=True"
            )

    def __iter__(self) -> Iterator[Iteration]:
        return self

    @abc.abstractmethod
    def __next__(self) -> Iteration:
        """Make an iteration: sample, update the policy, and evaluate it if it is time for that.

        Raises:
            FloatingPointError: An update is not finite, so that learning cannot go on.
        """

    @property
    def best_by(self) -> str:
        """The return by which a run selects its best policy and ends: "mean_return" or "return_mean".

        The first is the return of the policy after the iteration, the second that of the policy before it. By default
        it is the first, unless the configuration has a ``mean_every`` of 0.
        """
        return "return_mean" if getattr(self.config, "mean_every", None) == 0 else "mean_return"

    def settings(self) -> dict[str, Any]:
        """The hyperparameters as a run's config.json holds them."""
        return dataclasses.asdict(self.config)

    def state_dict(self) -> dict[str, Any]:
        """A copy of the state on which the next iteration depends, with the worlds of all processes.

        It consists of tensors, numbers, strings and containers of them. All processes must call it. Any number of
        processes can continue from it.
        """
        state = {
            "policy": self.policy.state_dict(),
            "env": self.team.gather(self.env.get_state()),
            "iteration": self.iteration,
            "samples": self.samples,
        }
        if self.value is not None:
            state["value"] = self.value.state_dict()
        if self.generator is not None:
            state["generator"] = self.generator.get_state()
        return copy.deepcopy(state)  # a module's own state_dict shares memory with its parameters

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue exactly where ``state_dict`` was taken.

        Raises:
            ValueError: The state has another number of worlds, or does not fit for another reason.
        """
        nworld = self.env.nworld * self.team.size
        if len(state["env"]) != nworld:
            raise ValueError(f"the state has {len(state['env'])} worlds, but the environment has {nworld}")
        self.policy.load_state_dict(state["policy"])
        if self.value is not None:
            self.value.load_state_dict(state["value"])
        if self.generator is not None:
            self.generator.set_state(state["generator"].cpu())
        self.env.set_state(state["env"][self._own].to(self.env.obs.device))
        self.iteration, self.samples = state["iteration"], state["samples"]
