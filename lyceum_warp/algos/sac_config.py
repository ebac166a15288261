"""Define and check the hyperparameters of SAC."""

import dataclasses
from typing import Any, Literal

from lyceum_warp.algos.common.hyperparameters import LEAST, check_fields
from lyceum_warp.algos.common.networks import Activation
from lyceum_warp.support.docstrings import document_attributes
from lyceum_warp.support.suggestions import suggest_arguments

_BOUNDS: dict[str, float | tuple[float, float]] = {
    "num_steps": 1, "replay": 1, "warmup": 0, "updates": 1, "actor_every": 1, "batch": 1, "n_step": 1, "quantiles": 1,
    "dropped_quantiles": 0, "mean_every": 0, "mean_episodes": 1, "gamma": (0.0, 1.0), "tau": (0.0, 1.0),
    "learning_rate": 0.0, "temperature": 1e-6, "target_entropy": LEAST, "action_limit": 1e-6, "symmetry_coef": 0.0,
}  # fmt: skip

MANY_WORLDS = 256

_FEW: dict[str, Any] = {
    "batch": 256, "actor_every": 1, "gamma": 0.99, "tau": 0.005, "temperature": 1.0, "target_entropy": -1.0,
    "critic_bound": "min", "hidden": (256, 256), "value_hidden": (256, 256),
}  # fmt: skip
"""Defaults for fewer than 256 worlds, from Haarnoja et al., 2018."""

_MANY: dict[str, Any] = {
    "batch": 8192, "actor_every": 4, "gamma": 0.97, "tau": 0.125, "temperature": 1e-3, "target_entropy": 0.0,
    "critic_bound": "mean", "hidden": (512, 256, 128), "value_hidden": (512, 512, 512),
}  # fmt: skip
"""Defaults for 256 worlds or more, close to the settings of Seo et al., 2025, for humanoids."""


@suggest_arguments
@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class SACConfig:
    """Hyperparameters of SAC.

    If a hyperparameter is None, its default depends on the number of worlds. Defaults for fewer than 256 worlds follow
    Haarnoja et al., 2018 ("Soft Actor-Critic Algorithms and Applications"). Defaults for 256 worlds or more are close
    to Seo et al., 2025 ("Learning Sim-to-Real Humanoid Locomotion in 15 Minutes").

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite, or ``dropped_quantiles`` leaves no
            quantile.
    """

    num_steps: int | None = None
    """Number of steps of every world per iteration. The default is 50, or more if 50 steps make fewer than 1,000
    samples."""
    replay: int | None = None
    """Capacity of the replay buffer in samples. The default is 1,024 steps of every world, but at least a million
    samples. The default buffer takes at most 30 % of the device's free memory."""
    warmup: int | None = None
    """Number of samples with random actions before the first update. The default is 10 steps of every world, but at
    least 5,000 samples."""
    updates: int | None = None
    """Number of updates of the critics after each step of all worlds. The default is the number of worlds, but at most
    8."""
    actor_every: int | None = None
    """Number of updates of the critics for each update of the actor; must divide ``updates``. The default is 4
    with 256 or more worlds, and otherwise 1."""
    batch: int | None = None
    """Number of samples in an update. The default is 8,192 samples with 256 or more worlds, and otherwise 256."""
    n_step: int = 1
    """Maximum number of rewards in a target of the critics (n-step returns)."""
    gamma: float | None = None
    """Discount factor. The default is 0.97 with 256 or more worlds, and otherwise 0.99."""
    tau: float | None = None
    """Fraction by which each update moves the target critics towards the critics (Polyak averaging). The default is
    0.125 with 256 or more worlds, and otherwise 0.005."""
    quantiles: int = 1
    """Number of quantiles that each critic predicts; with 1, it predicts the mean. TQC (Kuznetsov et al., 2020) uses
    25."""
    dropped_quantiles: int = 2
    """Number of dropped quantiles per critic, as in TQC. For each target, SAC pools the quantiles of both critics, and
    drops the largest. With one quantile, the targets use ``critic_bound`` instead."""
    critic_bound: Literal["min", "mean"] | None = None
    """Value of an action if ``quantiles`` is 1: the minimum or the mean of the two critics' predictions. The default is
    "mean" with 256 or more worlds, and otherwise "min"."""
    learning_rate: float = 3e-4
    """Learning rate of the actor, the critics and the temperature (Adam)."""
    temperature: float | None = None
    """Initial temperature, the learned weight of the entropy. The default is 0.001 with 256 or more worlds, and
    otherwise 1."""
    target_entropy: float | None = None
    """Target entropy of the policy for each element of an action, where actions are scaled to [-1, 1]. SAC adapts the
    temperature to reach it. The default is 0 with 256 or more worlds, and otherwise -1."""
    action_limit: float = 1.0
    """Largest absolute value of actions that the task does not bound."""
    hidden: tuple[int, ...] | None = None
    """Widths of the policy's hidden layers. With 256 or more worlds, the default is (512, 256, 128). With fewer worlds,
    it is (256, 256)."""
    activation: Activation = "relu"
    """Activation of the policy's hidden layers."""
    value_hidden: tuple[int, ...] | None = None
    """Widths of the critics' hidden layers. With 256 or more worlds, the default is (512, 512, 512). With fewer worlds,
    it is (256, 256)."""
    value_activation: Activation = "relu"
    """Activation of the critics' hidden layers."""
    value_group: str | None = None
    """Group of observations for the critics; by default "critic" if the task has this group, else "policy"."""
    layer_norm: bool = True
    """Whether to apply layer normalisation to the critics' hidden layers."""
    symmetry: Literal["none", "exact", "loss", "augment"] = "none"
    """How to use the mirror symmetry that a task declares (``lw.Mirror``). "exact" averages the policy with its mirror
    image. "loss" adds a term to the loss: symmetry_coef times the squared difference between the policy and its mirror
    image. "augment" also learns from the mirror images of all samples. "none" ignores the symmetry."""
    symmetry_coef: float = 1.0
    """Coefficient of the symmetry loss, if symmetry is "loss"."""
    normalize: bool = True
    """Whether to normalise observations by their running mean and variance, updated in every step."""
    tf32: bool = True
    """Whether matrix products on a GPU use TensorFloat-32."""
    bf16: bool = False
    """Whether SAC computes the losses in bfloat16 (torch.autocast)."""
    compiled: bool = False
    """Whether torch.compile compiles the losses. Compilation takes about half a minute."""
    mean_every: int = 10
    """Iterations between evaluations of the mean policy; 0 means no evaluations."""
    mean_episodes: int = 16
    """Number of episodes in an evaluation of the mean policy."""

    def __post_init__(self) -> None:
        """Check every value."""
        check_fields(self, _BOUNDS)
        if self.dropped_quantiles >= self.quantiles > 1:
            raise ValueError(
                f"dropped_quantiles={self.dropped_quantiles} must be less than quantiles, which is {self.quantiles}"
            )

    def resolved(self, nworld: int) -> "SACConfig":
        """Replace None by defaults in all fields except ``replay`` and ``value_group``.

        Args:
            nworld: Number of worlds of all processes.

        Raises:
            ValueError: ``actor_every`` does not divide ``updates``.
        """
        updates = min(nworld, 8)
        rules = {"num_steps": max(50, -(-1_000 // nworld)), "warmup": max(5_000, 10 * nworld), "updates": updates}
        defaults = rules | (_FEW if nworld < MANY_WORLDS else _MANY)
        config = dataclasses.replace(self, **{k: v for k, v in defaults.items() if getattr(self, k) is None})
        assert config.updates is not None and config.actor_every is not None
        if config.updates % config.actor_every:
            raise ValueError(
                f"updates={config.updates} must be a multiple of actor_every, which is {config.actor_every}"
            )
        return config
