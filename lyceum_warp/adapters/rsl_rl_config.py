"""Hyperparameters of rsl_rl's PPO, checked, and as the dictionary that rsl_rl takes. It works without rsl_rl."""

import dataclasses
import math
from typing import Any, Literal, get_args

import torch

from lyceum_warp.algos.networks import Activation, check_activation
from lyceum_warp.docstrings import document_attributes
from lyceum_warp.env import Env
from lyceum_warp.validate import finite_number, layer_sizes, whole_number

Bootstrap = Literal["final", "before"]
NormalizeWhen = Literal["step", "before", "after"]
Optimizer = Literal["adam", "adamw", "sgd", "rmsprop"]
Schedule = Literal["adaptive", "fixed"]
StdType = Literal["scalar", "log"]

_WHOLE = {"num_steps_per_env": 1, "num_learning_epochs": 1, "num_mini_batches": 1, "mean_every": 0, "mean_episodes": 1}
"""The smallest value of each whole number."""

_REAL = {
    "gamma": (0.0, 1.0), "lam": (0.0, 1.0), "clip_param": (0.0, math.inf), "value_loss_coef": (0.0, math.inf),
    "entropy_coef": (0.0, math.inf), "learning_rate": (0.0, math.inf), "desired_kl": (0.0, math.inf),
    "max_grad_norm": (0.0, math.inf), "init_std": (1e-6, 1e6), "final_entropy_coef": (0.0, math.inf),
}  # fmt: skip
"""The smallest and the largest value of each number."""

_CHOICES = {"bootstrap": Bootstrap, "optimizer": Optimizer, "schedule": Schedule, "std_type": StdType,
            "normalize_when": NormalizeWhen}  # fmt: skip
"""The values of each choice."""

_COMPILE_MODES = ("default", "max-autotune-no-cudagraphs")
"""The modes of torch.compile that rsl_rl takes: those without CUDA graphs."""

_FLAGS = ("use_clipped_value_loss", "normalize_advantage_per_mini_batch", "normalize", "random_start", "tf32",
          "batched_values")  # fmt: skip

_CAPTURED_OPTIMIZERS = ("adam", "adamw")
"""Optimizers whose steps can be captured."""

_ACTIVATIONS = {"leaky_relu": "lrelu", "silu": "swish"}
"""Activations that rsl_rl calls by another name."""

_HERE = "lyceum_warp.adapters.rsl_rl"
"""Where rsl_rl finds classes of this package."""

_PPO = (
    "num_learning_epochs", "num_mini_batches", "clip_param", "gamma", "lam", "value_loss_coef", "entropy_coef",
    "learning_rate", "max_grad_norm", "optimizer", "use_clipped_value_loss", "schedule", "desired_kl",
    "normalize_advantage_per_mini_batch",
)  # fmt: skip
"""The arguments of rsl_rl's PPO."""


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class RslRlConfig:
    """Hyperparameters of rsl_rl's PPO.

    The defaults are those of mjlab's tasks of legged robots, except that ``desired_kl`` is 0.01 there, ``bootstrap``
    "before", and ``normalize_when`` that of the installed rsl_rl. What NPG has, too, has the name that it has there;
    the others have rsl_rl's names.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """

    num_steps_per_env: int = 24
    """Steps of every world in an iteration."""
    num_learning_epochs: int = 5
    """Passes over the samples of an iteration."""
    num_mini_batches: int = 4
    """Mini-batches in a pass."""
    gamma: float = 0.99
    """Discount."""
    lam: float = 0.95
    """Decay of the generalised advantage estimate."""
    bootstrap: Bootstrap = "final"
    """What stands for the rest of an episode that the time limit or a fault cut off: "final" is the value of its final
    observation, "before" that of the observation before its last step, as in rsl_rl's own PPO."""
    clip_param: float = 0.2
    """How far the ratio of the new policy's density to the old one's may be from 1, and a value from its old one."""
    value_loss_coef: float = 1.0
    """Weight of the value function's loss."""
    use_clipped_value_loss: bool = True
    """Whether to limit a value's change from its old one by clip_param."""
    entropy_coef: float = 0.01
    """Weight of the policy's entropy."""
    final_entropy_coef: float | None = None
    """Weight of the policy's entropy from the last iteration of entropy_decay on; by default it stays the same."""
    entropy_decay: tuple[int, int] = (150, 200)
    """Iterations from the first to the second of which the entropy's weight falls linearly, where final_entropy_coef
    is given."""
    learning_rate: float = 1e-3
    """Learning rate, at first where it is adaptive."""
    schedule: Schedule = "adaptive"
    """"adaptive" divides the learning rate by 1.5 after a mini-batch whose KL divergence is more than twice desired_kl,
    and multiplies it by 1.5 where it is less than half, between 1e-5 and 1e-2."""
    desired_kl: float = 0.02
    """The KL divergence that the adaptive learning rate aims at. On go1_velocity PPO learns faster with 0.02 than
    with mjlab's 0.01 (bench/README.md)."""
    max_grad_norm: float = 1.0
    """Largest Euclidean length of a gradient, of the policy's and of the value function's."""
    optimizer: Optimizer = "adam"
    """The optimizer."""
    normalize_advantage_per_mini_batch: bool = False
    """Whether to scale advantages in each mini-batch, rather than over all samples."""
    hidden: tuple[int, ...] = (512, 256, 128)
    """Widths of the policy's hidden layers."""
    activation: Activation = "elu"
    """What follows each of the policy's hidden layers."""
    init_std: float = 1.0
    """Initial standard deviation of the policy's actions."""
    std_type: StdType = "scalar"
    """What is learned: the standard deviation ("scalar"), or its logarithm ("log")."""
    value_hidden: tuple[int, ...] = (512, 256, 128)
    """Widths of the value function's hidden layers."""
    value_activation: Activation = "elu"
    """What follows each of the value function's hidden layers."""
    value_group: str | None = None
    """Group of observations that the value function gets; by default "critic" where the task has such a group, else
    "policy"."""
    normalize: bool = True
    """Whether policy and value function normalise observations by their running mean and variance."""
    normalize_when: NormalizeWhen = "step"
    """When these statistics take in observations: "step" for those that each step leads to, as rsl_rl 5.4 does,
    "before" and "after" for all of an iteration, before or after the update. rsl_rl's own runner does what the
    installed rsl_rl does, which is "after" from 5.5 on."""
    random_start: bool = True
    """Whether the first episodes begin at random steps, so that time limits fall at all times."""
    tf32: bool = True
    """Whether matrix products on a GPU use TensorFloat-32."""
    batched_values: bool = True
    """Whether values and densities are computed once for all steps of an iteration, rather than in each step, which is
    faster on a GPU. They are the same up to rounding, except that values are normalised by the statistics at the end of
    the sampling where ``normalize_when`` is "step" or "before"."""
    captured_update: bool | None = None
    """Whether an epoch of the update is one CUDA graph, in which nothing waits for the device. It computes the same up
    to rounding. By default it is on a GPU, where the optimizer is "adam" or "adamw" and nothing is compiled."""
    torch_compile_mode: str | None = None
    """Mode of torch.compile for the networks, "default" or "max-autotune-no-cudagraphs"; by default they are not
    compiled."""
    mean_every: int = 20
    """Iterations between two evaluations of the mean policy; 0 for never. A shorter run has no best policy."""
    mean_episodes: int = 16
    """Episodes in an evaluation of the mean policy."""

    def __post_init__(self) -> None:
        checked: dict[str, Any] = {
            name: whole_number(name, getattr(self, name), low=low) for name, low in _WHOLE.items()
        }
        for name, (smallest, largest) in _REAL.items():
            if name == "final_entropy_coef" and self.final_entropy_coef is None:
                continue
            checked[name] = finite_number(name, getattr(self, name), low=smallest, high=largest)
        for name in ("hidden", "value_hidden"):
            checked[name] = tuple(layer_sizes(getattr(self, name), name))
            if not checked[name]:
                raise ValueError(f"{name} must be the widths of at least one hidden layer, as in (512, 256, 128)")
        checked["entropy_decay"] = _iterations("entropy_decay", self.entropy_decay)
        for name in ("activation", "value_activation"):
            check_activation(getattr(self, name), name)
        for name, value in checked.items():
            object.__setattr__(self, name, value)
        for name, choices in _CHOICES.items():
            if (choice := getattr(self, name)) not in get_args(choices):
                raise ValueError(f"{name} must be {' or '.join(map(repr, get_args(choices)))}, not {choice!r}")
        for name in _FLAGS:
            if not isinstance(flag := getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, not {flag!r}")
        if self.value_group is not None and not isinstance(self.value_group, str):
            raise ValueError(f"value_group must be a name, or None, not {self.value_group!r}")
        if (mode := self.torch_compile_mode) is not None and mode not in _COMPILE_MODES:
            modes = " or ".join(map(repr, _COMPILE_MODES))
            raise ValueError(f"torch_compile_mode must be {modes}, or None for no compilation, not {mode!r}")
        if self.captured_update is not None and not isinstance(self.captured_update, bool):
            raise ValueError(f"captured_update must be True, False or None, not {self.captured_update!r}")
        if self.captured_update and self.optimizer not in _CAPTURED_OPTIMIZERS:
            raise ValueError(f"captured_update needs the optimizer 'adam' or 'adamw', not {self.optimizer!r}")
        if self.captured_update and self.torch_compile_mode is not None:
            raise ValueError("captured_update and torch_compile_mode exclude each other: leave out one of them")

    def captures(self, device: torch.device) -> bool:
        """Whether an epoch of the update on this device is one CUDA graph."""
        if self.captured_update is not None:
            return self.captured_update
        return device.type == "cuda" and self.optimizer in _CAPTURED_OPTIMIZERS and self.torch_compile_mode is None

    def entropy_weight(self, iteration: int) -> float:
        """Weight of the policy's entropy in an iteration, of which the first one is 1."""
        if self.final_entropy_coef is None:
            return self.entropy_coef
        first, last = self.entropy_decay
        share = min(max((iteration - first) / (last - first), 0.0), 1.0)
        return self.entropy_coef + share * (self.final_entropy_coef - self.entropy_coef)

    def group(self, env: Env) -> str:
        """The group of observations that the value function gets.

        Raises:
            ValueError: The task has no such group.
        """
        group = self.value_group or ("critic" if "critic" in env.obs_groups else "policy")
        if group not in env.obs_groups:
            raise ValueError(
                f"the task {env.task.name!r} has no group {group!r} of observations for the value function: it has "
                f"{', '.join(env.obs_groups)}"
            )
        return group

    def runner_config(self, env: Env) -> dict[str, Any]:
        """What rsl_rl takes: ``OnPolicyRunner(RslRlVecEnv(env), config.runner_config(env))``.

        Args:
            env: The environment, whose groups of observations the networks get.

        Returns:
            A new dictionary, which rsl_rl changes.

        Raises:
            ValueError: The task lacks the value function's group, or the mini-batches are more than the samples.
        """
        if self.num_mini_batches > (samples := self.num_steps_per_env * env.nworld):
            raise ValueError(
                f"{self.num_mini_batches} mini-batches are more than the {samples} samples: give more worlds, or make "
                "num_mini_batches smaller"
            )
        network = {"class_name": "rsl_rl.models.MLPModel", "obs_normalization": self.normalize}
        gaussian = {"class_name": f"{_HERE}_distribution:AsynchronousGaussian", "std_type": self.std_type}
        final = f"{_HERE}_ppo:FinalObservationPPO"
        return {
            "num_steps_per_env": self.num_steps_per_env,
            "save_interval": 50,
            "check_for_nan": False,  # it would wait for the device; numbers that are not finite are faults
            "obs_groups": {"actor": ["policy"], "critic": [self.group(env)]},
            "actor": network | _layers(self.hidden, self.activation) | {
                "distribution_cfg": gaussian | {"init_std": self.init_std},
            },
            "critic": network | _layers(self.value_hidden, self.value_activation),
            "algorithm": {name: getattr(self, name) for name in _PPO} | {
                "class_name": final if self.bootstrap == "final" else "rsl_rl.algorithms.PPO", "rnd_cfg": None,
            },
            "multi_gpu": None,
            "torch_compile_mode": self.torch_compile_mode,
        }  # fmt: skip


def _iterations(name: str, value: Any) -> tuple[int, int]:
    """Two numbers of iterations, the second of which is larger.

    Raises:
        ValueError: The value is something else.
    """
    try:
        first, last = value
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be two numbers of iterations, as in (150, 200), not {value!r}") from None
    pair = whole_number(name, first, low=0), whole_number(name, last, low=1)
    if pair[0] >= pair[1]:
        raise ValueError(f"{name} must end after it begins, not {value!r}")
    return pair


def _layers(hidden: tuple[int, ...], activation: str) -> dict[str, Any]:
    return {"hidden_dims": list(hidden), "activation": _ACTIVATIONS.get(activation, activation)}
