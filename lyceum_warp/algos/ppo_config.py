"""Define and check the hyperparameters of PPO."""

import dataclasses
from typing import Any, Literal

from lyceum_warp.algos.common.hyperparameters import check_fields
from lyceum_warp.algos.common.networks import Activation
from lyceum_warp.support.docstrings import document_attributes
from lyceum_warp.support.suggestions import suggest_arguments
from lyceum_warp.support.validate import whole_number

_BOUNDS: dict[str, float | tuple[float, float]] = {
    "num_steps": 1, "epochs": 1, "minibatches": 1, "mean_every": 0, "mean_episodes": 1, "gamma": (0.0, 1.0),
    "lam": (0.0, 1.0), "clip": 0.0, "value_coef": 0.0, "entropy_coef": 0.0, "final_entropy_coef": 0.0,
    "learning_rate": 0.0, "symmetry_coef": 0.0, "desired_kl": 0.0, "max_grad_norm": 0.0, "log_std": (-13.8, 13.8),
}  # fmt: skip


@suggest_arguments
@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """Hyperparameters of PPO. Except for ``desired_kl``, the defaults are mjlab's settings for legged robots.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """

    num_steps: int = 24
    """Number of steps of every world per iteration."""
    epochs: int = 5
    """Number of passes over an iteration's samples."""
    minibatches: int = 4
    """Number of mini-batches per epoch, all of the same size. Samples that are left over are not used."""
    gamma: float = 0.99
    """Discount factor."""
    lam: float = 0.95
    """Lambda of the generalised advantage estimate."""
    clip: float = 0.2
    """PPO clips the probability ratio to the range from 1 - clip to 1 + clip. With clip_value_loss, it also clips the
    change of a predicted value to the range from -clip to clip."""
    clip_value_loss: bool = True
    """Whether the value loss is the larger of the prediction's error and the clipped prediction's error."""
    value_coef: float = 1.0
    """Coefficient of the value loss."""
    entropy_coef: float = 0.01
    """Coefficient of the policy's entropy."""
    final_entropy_coef: float | None = None
    """Entropy coefficient after entropy_decay; by default the coefficient stays constant."""
    entropy_decay: tuple[int, int] = (150, 200)
    """First and last iteration of the linear change from entropy_coef to final_entropy_coef."""
    learning_rate: float = 1e-3
    """Learning rate of Adam, or the initial learning rate if schedule is "adaptive"."""
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    """"adaptive" divides the learning rate by 1.5 if a mini-batch's KL divergence exceeds twice desired_kl, and
    multiplies it by 1.5 if the divergence is below half of desired_kl. The learning rate stays between 1e-5 and
    1e-2."""
    desired_kl: float = 0.02
    """Target KL divergence of the adaptive learning rate. PPO learns go1_velocity faster with 0.02 than with mjlab's
    0.01 (bench/README.md)."""
    max_grad_norm: float = 1.0
    """Maximum Euclidean norm of the gradient, for the policy and the value function separately."""
    whiten_minibatches: bool = False
    """Whether to normalise advantages within each mini-batch instead of over all samples."""
    hidden: tuple[int, ...] = (512, 256, 128)
    """Widths of the policy's hidden layers."""
    activation: Activation = "elu"
    """Activation of the policy's hidden layers."""
    log_std: float = 0.0
    """Initial logarithm of the policy's standard deviations."""
    std_type: Literal["scalar", "log"] = "scalar"
    """Whether Adam learns the standard deviations ("scalar") or their logarithms ("log")."""
    value_hidden: tuple[int, ...] = (512, 256, 128)
    """Widths of the value function's hidden layers."""
    value_activation: Activation = "elu"
    """Activation of the value function's hidden layers."""
    value_group: str | None = None
    """Group of observations for the value function; by default "critic" if the task has this group, else "policy"."""
    symmetry: Literal["none", "exact", "loss", "augment"] = "none"
    """How to use the mirror symmetry that a task declares (``lw.Mirror``). "exact" averages the policy with its mirror
    image. "loss" adds a term to the loss: symmetry_coef times the squared difference between the policy and its mirror
    image. "augment" also learns from the mirror images of all samples. "none" ignores the symmetry."""
    symmetry_coef: float = 1.0
    """Coefficient of the symmetry loss, if symmetry is "loss"."""
    normalize: bool = True
    """Whether to normalise observations by their running mean and variance, updated in every step."""
    stagger: bool = True
    """Whether the first episodes start at random steps, so that time limits are spread over time. On the Warp engine,
    this has no effect if the task sets ``lw.Task.settle``."""
    tf32: bool = True
    """Whether matrix products on a GPU use TensorFloat-32."""
    mean_every: int = 20
    """Iterations between evaluations of the mean policy; 0 means no evaluations. A run with fewer iterations than
    ``mean_every`` has no best policy."""
    mean_episodes: int = 16
    """Number of episodes in an evaluation of the mean policy."""

    def __post_init__(self) -> None:
        check_fields(self, _BOUNDS)
        object.__setattr__(self, "entropy_decay", _iterations("entropy_decay", self.entropy_decay))

    def entropy_weight(self, iteration: int) -> float:
        """Compute the entropy coefficient of an iteration; the first iteration is number 1."""
        if self.final_entropy_coef is None:
            return self.entropy_coef
        first, last = self.entropy_decay
        share = min(max((iteration - first) / (last - first), 0.0), 1.0)
        return self.entropy_coef + share * (self.final_entropy_coef - self.entropy_coef)


def _iterations(name: str, value: Any) -> tuple[int, int]:
    try:
        first, last = value
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a first and a last iteration, such as (150, 200), not {value!r}") from None
    pair = whole_number(name, first, low=0), whole_number(name, last, low=1)
    if pair[0] >= pair[1]:
        raise ValueError(f"{name} must have a last iteration after the first iteration, not {value!r}")
    return pair
