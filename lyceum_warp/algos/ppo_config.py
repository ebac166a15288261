"""Hyperparameters of PPO."""

import dataclasses
from typing import Any, Literal

from lyceum_warp.algos.hyperparameters import check_fields
from lyceum_warp.algos.networks import Activation
from lyceum_warp.support.docstrings import document_attributes
from lyceum_warp.support.validate import whole_number

_BOUNDS: dict[str, float | tuple[float, float]] = {
    "num_steps": 1, "epochs": 1, "minibatches": 1, "mean_every": 0, "mean_episodes": 1, "gamma": (0.0, 1.0),
    "lam": (0.0, 1.0), "clip": 0.0, "value_coef": 0.0, "entropy_coef": 0.0, "final_entropy_coef": 0.0,
    "learning_rate": 0.0, "desired_kl": 0.0, "max_grad_norm": 0.0, "log_std": (-13.8, 13.8),
}  # fmt: skip


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Hyperparameters of PPO. The defaults are mjlab's for legged robots, but with a ``desired_kl`` of 0.02.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """

    num_steps: int = 24
    """Steps of every world in an iteration."""
    epochs: int = 5
    """Passes over the samples of an iteration."""
    minibatches: int = 4
    """Mini-batches in a pass. Samples that are left over when all of them have the same size are not used."""
    gamma: float = 0.99
    """Discount."""
    lam: float = 0.95
    """Decay of the generalised advantage estimate."""
    clip: float = 0.2
    """How far the probability ratio of the new to the old policy may be from 1 in the surrogate, and, with
    clip_value_loss, a value from its old one."""
    clip_value_loss: bool = True
    """Whether the value function's loss also counts its prediction clipped to the old one plus and minus clip, and
    takes the larger error."""
    value_coef: float = 1.0
    """Weight of the value function's loss."""
    entropy_coef: float = 0.01
    """Weight of the policy's entropy."""
    final_entropy_coef: float | None = None
    """Weight of the policy's entropy from the last iteration of entropy_decay on; by default it stays the same."""
    entropy_decay: tuple[int, int] = (150, 200)
    """Iterations between which the entropy's weight falls linearly, if final_entropy_coef is given."""
    learning_rate: float = 1e-3
    """Learning rate (Adam), at first if it is adaptive."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """"adaptive" divides the learning rate by 1.5 after a mini-batch with a KL divergence of more than twice
    desired_kl, and multiplies it by 1.5 after one of less than half, between 1e-5 and 1e-2."""
    desired_kl: float = 0.02
    """The KL divergence that the adaptive learning rate aims at. On go1_velocity PPO learns faster with 0.02 than
    with mjlab's 0.01 (bench/README.md)."""
    max_grad_norm: float = 1.0
    """Largest Euclidean length of the gradient, of the policy's and of the value function's apart."""
    whiten_minibatches: bool = False
    """Whether to scale the advantages to mean 0 and standard deviation 1 in each mini-batch, rather than over all
    samples."""
    hidden: tuple[int, ...] = (512, 256, 128)
    """Widths of the policy's hidden layers."""
    activation: Activation = "elu"
    """What follows each of the policy's hidden layers."""
    log_std: float = 0.0
    """Initial logarithm of the policy's standard deviations."""
    std_type: Literal["scalar", "log"] = "scalar"
    """Whether Adam learns the standard deviations ("scalar") or their logarithms ("log")."""
    value_hidden: tuple[int, ...] = (512, 256, 128)
    """Widths of the value function's hidden layers."""
    value_activation: Activation = "elu"
    """What follows each of the value function's hidden layers."""
    value_group: str | None = None
    """Group of observations that the value function gets; by default "critic" if the task has such a group, else
    "policy"."""
    normalize: bool = True
    """Whether policy and value function normalise observations by their running mean and variance, which every step
    updates."""
    stagger: bool = True
    """Whether the first episodes begin at random steps, so that time limits fall at all times."""
    tf32: bool = True
    """Whether matrix products on a GPU use TensorFloat-32."""
    mean_every: int = 20
    """Iterations between two evaluations of the mean policy; 0 for never. A shorter run has no best policy."""
    mean_episodes: int = 16
    """Episodes in an evaluation of the mean policy."""

    def __post_init__(self) -> None:
        """Check every value."""
        check_fields(self, _BOUNDS)
        object.__setattr__(self, "entropy_decay", _iterations("entropy_decay", self.entropy_decay))

    def entropy_weight(self, iteration: int) -> float:
        """Weight of the policy's entropy in an iteration, of which the first one is 1."""
        if self.final_entropy_coef is None:
            return self.entropy_coef
        first, last = self.entropy_decay
        share = min(max((iteration - first) / (last - first), 0.0), 1.0)
        return self.entropy_coef + share * (self.final_entropy_coef - self.entropy_coef)


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
