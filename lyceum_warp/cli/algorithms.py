"""Map the flags of lyceum-warp train to the hyperparameters of its algorithms, and to learners."""

import dataclasses
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar

import tyro

from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.learner import Learner
from lyceum_warp.algos.npg import NPG
from lyceum_warp.algos.npg_config import NPGConfig, enough_samples
from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.ppo import PPO
from lyceum_warp.algos.ppo_config import PPOConfig
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.cli.arguments import given, spelled
from lyceum_warp.docstrings import attribute_docs
from lyceum_warp.env import Env

AlgorithmName = Literal["npg", "ppo"]

Class = TypeVar("Class")


def hyperparameter_flags(**configs: type) -> Callable[[type[Class]], type[Class]]:
    """Class decorator: add the hyperparameters of all algorithms as flags, of which one of the same name is one flag.

    A flag that is not given is None; a bool keeps its default, which all algorithms share that have it.

    Args:
        configs: The configurations' classes by the names of their algorithms.
    """

    def decorated(cls: type[Class]) -> type[Class]:
        annotations: dict[str, Any] = {}
        for name in dict.fromkeys(field.name for config in configs.values() for field in dataclasses.fields(config)):
            having = {of: config for of, config in configs.items() if hasattr(config, name)}
            first = next(iter(having.values()))
            hint, default = typing.get_type_hints(first)[name], getattr(first, name)
            text = " ".join(attribute_docs(first)[name].split())
            defaults = ", ".join(f"{of} {_shown(getattr(config, name))}" for of, config in having.items())
            arg: dict[str, Any] = {"help": text, "help_behavior_hint": f"(default: {defaults})"}
            if isinstance(default, bool):
                annotations[name] = Annotated[hint, tyro.conf.arg(**arg)]
                setattr(cls, name, default)
            else:
                annotations[name] = Annotated[hint | None, tyro.conf.arg(metavar=_metavar(hint), **arg)]
                setattr(cls, name, None)
        cls.__annotations__ = annotations
        return dataclasses.dataclass(frozen=True, kw_only=True)(cls)

    return decorated


def _shown(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _metavar(hint: Any) -> str:
    """What a flag's help shows for its values."""
    kinds = typing.get_args(hint)
    if typing.get_origin(hint) is Literal:
        return f"{{{','.join(kinds)}}}"
    if typing.get_origin(hint) is tuple:
        kind = kinds[0].__name__.upper()
        return f"[{kind} [{kind} ...]]" if kinds[1] is Ellipsis else " ".join([kind] * len(kinds))
    (kind,) = [kind for kind in kinds if kind is not type(None)] or [hint]
    return str(kind.__name__.upper())


@hyperparameter_flags(npg=NPGConfig, ppo=PPOConfig)
class LearnerFlags:
    """Hyperparameters of the algorithm."""


Networks = tuple[GaussianPolicy | None, ValueFunction | None]
"""The policy and the value function that an algorithm begins with; None for new ones."""


@dataclasses.dataclass(frozen=True)
class Algorithm:
    """An algorithm of the command."""

    name: AlgorithmName
    """What --algorithm and config.json call it; its hyperparameters have this name in config.json."""
    config_type: type
    """The class of its hyperparameters."""
    learner_type: Callable[..., Learner]
    """The class of its learner."""
    sampling: Callable[[Any], str]
    """What a learner samples in each world in an iteration, in a few words."""

    def config(self, flags: LearnerFlags) -> Any:
        """The hyperparameters.

        Raises:
            ValueError: A value is not valid, or a hyperparameter of another algorithm is given.
        """
        known = {field.name for field in dataclasses.fields(self.config_type)}
        if others := [name for name in given(flags) if name not in known]:
            (owner,) = [other.name for other in ALGORITHMS.values() if hasattr(other.config_type, others[0])]
            raise ValueError(
                f"{flag(others[0])} is a setting of {owner}, not of {self.name}: leave it out, or give "
                f"--algorithm {owner}"
            )
        values = {name: value for name, value in vars(flags).items() if name in known and value is not None}
        return self.config_type(**values)

    def flags(self, entry: Mapping[str, Any]) -> LearnerFlags:
        """The flags that stand for its entry in config.json.

        Raises:
            TypeError: The entry has unknown hyperparameters.
            ValueError: A value is not valid.
        """
        return LearnerFlags(**vars(self.config_type(**entry)))

    def entry(self, config: Any, nworld: int) -> dict[str, Any]:
        """Its entry in config.json.

        Args:
            config: The hyperparameters.
            nworld: Number of worlds.
        """
        samples = {"samples": enough_samples(config, nworld)} if isinstance(config, NPGConfig) else {}
        return dataclasses.asdict(config) | samples

    def learner(self, entry: Mapping[str, Any], env: Env, networks: Networks, *, seed: int, team: Team) -> Learner:
        """Make it.

        Args:
            entry: Its entry in config.json.
            env: The environment.
            networks: The networks that it begins with.
            seed: Seed of new networks and of the noise.
            team: The processes.
        """
        return self.learner_type(env, *networks, self.config_type(**entry), seed=seed, team=team)


def _npg_sampling(npg: NPG) -> str:
    return f"{'segments' if npg.segments else 'episodes'} of {npg.rollout.steps} steps"


_NPG = Algorithm("npg", NPGConfig, NPG, _npg_sampling)
_PPO = Algorithm("ppo", PPOConfig, PPO, lambda ppo: f"segments of {ppo.rollout.steps} steps")

ALGORITHMS: dict[str, Algorithm] = {algorithm.name: algorithm for algorithm in (_NPG, _PPO)}
"""The algorithms by their names."""


def flag(name: str) -> str:
    """The flag of a hyperparameter."""
    return f"--{name.replace('_', '-')}"


def run_algorithm(config: Mapping[str, Any]) -> tuple[Algorithm, dict[str, Any]] | None:
    """The algorithm that begins with a run's policy, and its entry in config.json; None for one of a program.

    A run of rsl-rl, of earlier releases, is one of ppo.

    Args:
        config: The content of the run's config.json.
    """
    name = config.get("algorithm", "")
    if name == "rsl-rl":
        entry = {new: config[name][old] for old, new in _RSL_RL.items() if old in config[name]}
        return _PPO, entry | {"log_std": math.log(config[name].get("init_std", 1.0))}
    return None if name not in ALGORITHMS else (ALGORITHMS[name], config[name])


_RSL_RL = {
    "num_steps_per_env": "num_steps", "num_learning_epochs": "epochs", "num_mini_batches": "minibatches",
    "clip_param": "clip", "use_clipped_value_loss": "clip_value_loss", "value_loss_coef": "value_coef",
    "normalize_advantage_per_mini_batch": "whiten_minibatches", "random_start": "stagger",
    **{name: name for name in (
        "gamma", "lam", "entropy_coef", "final_entropy_coef", "entropy_decay", "learning_rate", "schedule",
        "desired_kl", "max_grad_norm", "hidden", "activation", "std_type", "value_hidden", "value_activation",
        "value_group", "normalize", "tf32", "mean_every", "mean_episodes",
    )},
}  # fmt: skip
"""Hyperparameters of the former algorithm rsl-rl, and what ppo calls them."""


def refuse_rsl_rl(arguments: Sequence[str]) -> None:
    """Refuse the former algorithm rsl-rl and its flags.

    Raises:
        ValueError: One of them is given; the message names what replaced it.
    """
    if arguments[:1] != ["train"]:
        return
    old = [argument.partition("=")[0] for argument in arguments if argument.startswith("--config.")]
    if not old and "rsl-rl" not in spelled(arguments).replace("=", ",").split(","):
        return
    text = "--algorithm rsl-rl is now --algorithm ppo, whose flags have no prefix"
    for argument in old[:1]:
        name = argument.removeprefix("--config.").replace("-", "_").removeprefix("no_")
        new = {**_RSL_RL, "init_std": "log_std"}.get(name)
        text += f": {argument} is {flag(new)}" if new else f": it has no {argument}"
    raise ValueError(f"{text} (docs/ppo.md)")
