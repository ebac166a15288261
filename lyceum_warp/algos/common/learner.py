"""Define the interface of learning algorithms."""

import abc
import copy
import dataclasses
import inspect
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import torch

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.algos.common.replay import Replay
from lyceum_warp.env.env import Env
from lyceum_warp.kernels import collect, returns
from lyceum_warp.support.validate import check_kind, whole_number

LEARNER_KERNELS = (collect.store_steps, returns.advantages)
"""A kernel of each module that learners launch."""

METRIC_COLUMN, STEP_METRIC_COLUMN = "metrics/", "step_metrics/"
"""Prefixes of the metrics' columns in metrics.csv: sums over an episode, and means over all samples."""

NESTED = ("metrics", "step_metrics", "numbers")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Iteration:
    """Statistics of one iteration of a learner. Numbers that a learner does not report are None.

    An algorithm reports additional numbers in ``numbers``, or in fields of a subclass.
    """

    iteration: int
    """Number of the iteration, counted from 1."""
    samples: int
    """Number of samples in all iterations so far."""
    reward_mean: float | None = None
    """Mean reward of a step, over all samples."""
    return_mean: float | None = None
    """Mean return (sum of rewards) of the episodes that ended during sampling; NaN if no episode ended."""
    return_std: float | None = None
    """Standard deviation of the returns of the episodes that ended during sampling."""
    return_min: float | None = None
    """Smallest return of the episodes that ended during sampling."""
    return_max: float | None = None
    """Largest return of the episodes that ended during sampling."""
    length_mean: float | None = None
    """Mean number of steps in an episode."""
    terminal_reward: float | None = None
    """Mean reward of an episode's last step."""
    eval_mean: float | None = None
    """Mean evaluation metric at the end of an episode."""
    success: float | None = None
    """Fraction of episodes that ended with the goal met; NaN if the task does not define ``success``."""
    mean_return: float | None = None
    """Mean return of the policy without noise, evaluated after the iteration; None without an evaluation."""
    mean_length: float | None = None
    """Mean length of the evaluated episodes, in steps."""
    mean_terminal_reward: float | None = None
    """Mean reward of the last step of the evaluated episodes."""
    mean_eval: float | None = None
    """Mean evaluation metric at the end of the evaluated episodes."""
    mean_success: float | None = None
    """Fraction of the evaluated episodes that ended with the goal met; None if the task does not define ``success``."""
    metrics: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Each metric of the task, summed over an episode and averaged over episodes."""
    step_metrics: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Each metric of the task, averaged over all samples."""
    numbers: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Additional numbers of the algorithm; the keys are columns of metrics.csv."""

    def row(self) -> dict[str, Any]:
        """Convert the statistics to a row of metrics.csv, without values that are None.

        The metric ``x`` has the columns ``metrics/x`` and ``step_metrics/x``.
        """
        names = [field.name for field in dataclasses.fields(self) if field.name not in NESTED]
        row = {name: number for name in names if (number := getattr(self, name)) is not None} | dict(self.numbers)
        columns = ((METRIC_COLUMN, self.metrics), (STEP_METRIC_COLUMN, self.step_metrics))
        return row | {prefix + name: mean for prefix, means in columns for name, mean in means.items()}


class Learner(abc.ABC):
    """Base class of learning algorithms; a learner is an infinite iterator of ``Iteration``.

    A subclass sets ``algorithm``, ``policy`` and ``config``. It implements ``__next__``, which must also increase
    ``iteration`` and ``samples``. A subclass with more state extends ``state_dict`` and ``load_state_dict``. For an
    example, see docs/learners.md.

    Args:
        env: The environment, which must not be stepped between iterations.
        seed: Seed of new networks and of the noise.
        team: The processes that learn together, each with some of the worlds; by default only this process.

    Raises:
        ValueError: The environment does not reset automatically, ``first_world`` does not match this process's rank, or
            the seed is not a whole number.
    """

    sees: ClassVar[bool] = False
    """Whether the policy may see cameras."""
    algorithm: str
    """Name of the algorithm, and the key of its hyperparameters in a run's config.json."""
    env: Env
    """The environment that provides the samples."""
    policy: torch.nn.Module
    """The policy after the last iteration. Its method ``act`` maps unnormalised observations (..., nobs) to actions
    without noise (..., nact). The policy has the attributes ``nobs`` and ``nact``. A policy with memory has the
    attribute ``state_size``, and ``act(obs, state)`` returns the actions and the next state."""
    value: torch.nn.Module | None = None
    """The value function after the last iteration; None for algorithms without a value function."""
    config: Any
    """The hyperparameters, a dataclass."""
    seed: int
    """Seed of new networks and of the noise."""
    team: Team
    """The processes that learn together."""
    generator: torch.Generator | None = None
    """The random generator, if the algorithm has one."""
    replay: Replay | None = None
    """The replay buffer, if the algorithm has one. A run saves the buffer in separate files, not in ``state_dict``,
    because the buffer is large."""
    teacher: torch.nn.Module | None = None
    """What the policy imitates, if the algorithm has a teacher. A run saves it once, in ``teacher.pt``."""
    own_worlds: slice
    """Indices of this process's worlds among the worlds of all processes."""
    iteration: int
    """Number of complete iterations."""
    samples: int
    """Number of samples in all iterations so far."""

    def __init__(self, env: Env, *, seed: int = 0, team: Team | None = None) -> None:
        check_kind(f"env of {type(self).__name__}", env, Env, "as lw.make(...) makes it")
        self.env, self.seed = env, whole_number("seed", seed, low=0)
        self.team = team = team or Team()
        self.iteration = self.samples = 0
        n = env.nworld
        self.own_worlds = slice(team.rank * n, (team.rank + 1) * n)
        if team.size > 1 and env.first_world != self.own_worlds.start:
            raise ValueError(
                f"process {team.rank} of {team.size} with {n} worlds needs an environment with "
                f"first_world={self.own_worlds.start}, not {env.first_world}"
            )
        if env.task.cameras and not self.sees:
            raise ValueError(
                f"{type(self).__name__} cannot learn from cameras: make the environment with cameras=[] (--cameras '')"
            )
        if not env.autoreset:
            raise ValueError(
                f"{type(self).__name__} needs an environment that resets automatically: make the environment with "
                "autoreset=True"
            )

    def __iter__(self) -> Iterator[Iteration]:
        return self

    @abc.abstractmethod
    def __next__(self) -> Iteration:
        """Run one iteration: sample, update the policy, and evaluate the policy if due.

        Raises:
            FloatingPointError: An update is not finite, so learning cannot continue.
        """

    @property
    def best_by(self) -> str:
        """The field of ``Iteration`` that a run uses to select its best policy and to check its target return.

        "mean_return" is the return of the updated policy, which acts without noise. "return_mean" is the return of the
        episodes sampled for the update, in which the old policy acts with noise. The default is "mean_return", or
        "return_mean" if the configuration has ``mean_every=0``.
        """
        return "return_mean" if getattr(self.config, "mean_every", None) == 0 else "mean_return"

    @property
    def title(self) -> str:
        """Name of the algorithm in messages."""
        return self.algorithm

    def settings(self) -> dict[str, Any]:
        """Return the hyperparameters for a run's config.json."""
        return dataclasses.asdict(self.config)

    def state_dict(self) -> dict[str, Any]:
        """Copy the learner's state. It includes the worlds of all processes, but not ``replay``.

        The state consists of tensors, numbers, strings, dicts and lists. All processes must call this method. Any
        number of processes can resume from the state.
        """
        state = {
            "policy": self.policy.state_dict(),
            "env": self.team.gather(self.env.get_state()),
            "shared": self.env.get_shared(),
            "iteration": self.iteration,
            "samples": self.samples,
        }
        if self.value is not None:
            state["value"] = self.value.state_dict()
        if self.generator is not None:
            state["generator"] = self.generator.get_state()
        if self.replay is not None:
            state["stored"] = self.replay.stored
        return copy.deepcopy(state)  # state_dict() shares memory with the parameters

    def enter(self, env: Env) -> None:
        """Go on in another environment of the same task, such as one with finer physics, with the same state.

        This calls the constructor again, with ``env`` and the networks. A subclass with other arguments overrides this
        method.
        """
        state, replay = self.state_dict(), self.replay
        make: Any = self.__init__  # type: ignore[misc]
        make(env, self.policy, self.value, self.config, seed=self.seed, team=self.team)
        if replay is not None:
            self.replay, replay.env = replay, env
        self.load_state_dict(state)

    def check_enter(self) -> None:
        """Check that ``enter`` can call the constructor."""
        if type(self).enter is Learner.enter:
            kind = type(self)
            try:
                inspect.signature(kind).bind(self.env, None, None, self.config, seed=self.seed, team=self.team)
            except TypeError as error:
                raise TypeError(
                    f"{kind.__name__} can't change to exact physics ({error}): give its constructor the arguments env, "
                    "policy, value, config, seed and team, or override enter"
                ) from error

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a result of ``state_dict``. Later iterations equal those of an uninterrupted run bit for bit.

        Raises:
            ValueError: The state has a different number of worlds, or other sizes than the task's memory, or a counter
                is not a whole number.
        """
        nworld = self.env.nworld * self.team.size
        if len(state["env"]) != nworld:
            raise ValueError(f"the state has {len(state['env'])} worlds, but the environment has {nworld}")
        sizes = {
            "a world": (state["env"].shape[1], self.env.state_space.size),
            "shared memory": (len(state["shared"]), len(self.env.get_shared())),
        }
        for part, (size, expected) in sizes.items():
            if size != expected:
                raise ValueError(
                    f"the state of {part} has {size} numbers, and the task needs {expected}: another version of the "
                    "task has saved it"
                )
        self.policy.load_state_dict(state["policy"])
        if self.value is not None:
            self.value.load_state_dict(state["value"])
        if self.generator is not None:
            self.generator.set_state(state["generator"].cpu())
        self.env.set_shared(state["shared"].to(self.env.obs.device))
        self.env.set_state(state["env"][self.own_worlds].to(self.env.obs.device))
        self.iteration = whole_number("iteration", state["iteration"], low=0)
        self.samples = whole_number("samples", state["samples"], low=0, high=2**63 - 1)
