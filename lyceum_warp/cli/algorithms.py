"""The algorithms of lyceum-warp train: their flags, their entries in config.json, and how each is made."""

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from lyceum_warp.adapters.rsl_rl_config import RslRlConfig
from lyceum_warp.adapters.rsl_rl_release import check_rsl_rl
from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.learner import Learner
from lyceum_warp.algos.npg import NPG
from lyceum_warp.algos.npg_config import NPGConfig, enough_samples
from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.cli.arguments import optional_flags
from lyceum_warp.env import Env

AlgorithmName = Literal["npg", "rsl-rl"]


@optional_flags(NPGConfig)
class NPGOptions:
    """Hyperparameters of the natural policy gradient."""

    def checked(self) -> NPGConfig:
        """The hyperparameters.

        Raises:
            ValueError: A value is of the wrong type, out of range or not finite.
        """
        return NPGConfig(**vars(self))


@optional_flags(RslRlConfig)
class RslRlOptions:
    """Hyperparameters of rsl_rl's PPO, for --algorithm rsl-rl."""

    def checked(self) -> RslRlConfig:
        """The hyperparameters.

        Raises:
            ValueError: A value is of the wrong type, out of range or not finite.
        """
        return RslRlConfig(**vars(self))


class Algorithm(abc.ABC):
    """An algorithm of the command. Its flags are an attribute of the command's options."""

    name: ClassVar[AlgorithmName]
    """What --algorithm and config.json call it; its hyperparameters have this name in config.json."""
    title: ClassVar[str]
    """What messages call it."""
    flags: ClassVar[str]
    """The attribute of the command's options that holds its flags."""
    prefix: ClassVar[str]
    """What its flags begin with."""

    @abc.abstractmethod
    def check(self, team: Team) -> None:
        """Check that it can be used here.

        Raises:
            ImportError: It needs a package that is not installed.
            ValueError: It cannot learn in several processes.
        """

    @abc.abstractmethod
    def options(self, entry: Mapping[str, Any]) -> Any:
        """The flags that stand for its entry in config.json.

        Raises:
            TypeError: The entry has unknown hyperparameters.
            ValueError: A value is not valid.
        """

    @abc.abstractmethod
    def entry(self, config: Any, nworld: int) -> dict[str, Any]:
        """Its entry in config.json.

        Args:
            config: The hyperparameters.
            nworld: Number of worlds.
        """

    @abc.abstractmethod
    def learner(
        self, entry: Mapping[str, Any], env: Env, networks: tuple[GaussianPolicy | None, ValueFunction | None], *,
        seed: int, team: Team,
    ) -> Learner:  # fmt: skip
        """Make it.

        Args:
            entry: Its entry in config.json.
            env: The environment.
            networks: The policy and the value function that it begins with; None for new ones.
            seed: Seed of new networks and of the noise.
            team: The processes.
        """

    @abc.abstractmethod
    def sampling(self, learner: Any) -> str:
        """What it samples in each world in an iteration, in a few words."""


class _NPG(Algorithm):
    """The natural policy gradient."""

    name, title, flags, prefix = "npg", "NPG", "npg", "--"

    def check(self, team: Team) -> None:
        pass

    def options(self, entry: Mapping[str, Any]) -> NPGOptions:
        return NPGOptions(**vars(NPGConfig(**entry)))

    def entry(self, config: NPGConfig, nworld: int) -> dict[str, Any]:
        return dataclasses.asdict(config) | {"samples": enough_samples(config, nworld)}

    def learner(
        self, entry: Mapping[str, Any], env: Env, networks: tuple[GaussianPolicy | None, ValueFunction | None], *,
        seed: int, team: Team,
    ) -> NPG:  # fmt: skip
        return NPG(env, *networks, NPGConfig(**entry), seed=seed, team=team)

    def sampling(self, learner: NPG) -> str:
        return f"{'segments' if learner.segments else 'episodes'} of {learner.rollout.steps} steps"


class _RslRl(Algorithm):
    """rsl_rl's PPO."""

    name, title, flags, prefix = "rsl-rl", "rsl-rl", "config", "--config."

    def check(self, team: Team) -> None:
        check_rsl_rl()
        if team.size > 1:
            raise ValueError(f"--algorithm rsl-rl learns in one process, not in {team.size}: start it without torchrun")

    def options(self, entry: Mapping[str, Any]) -> RslRlOptions:
        return RslRlOptions(**vars(RslRlConfig(**entry)))

    def entry(self, config: RslRlConfig, nworld: int) -> dict[str, Any]:
        return dataclasses.asdict(config)

    def learner(
        self, entry: Mapping[str, Any], env: Env, networks: tuple[GaussianPolicy | None, ValueFunction | None], *,
        seed: int, team: Team,
    ) -> Learner:  # fmt: skip
        from lyceum_warp.adapters.rsl_rl_learner import RslRlLearner

        return RslRlLearner(env, *networks, RslRlConfig(**entry), seed=seed)

    def sampling(self, learner: Any) -> str:
        return f"segments of {learner.rollout.steps} steps for rsl_rl's PPO"


_ALL: tuple[Algorithm, ...] = (_NPG(), _RslRl())

ALGORITHMS: dict[str, Algorithm] = {algorithm.name: algorithm for algorithm in _ALL}
"""The algorithms by their names."""
