"""Define and check the hyperparameters of NPG."""

import dataclasses
from typing import Literal

from lyceum_warp.algos.common.hyperparameters import LEAST, check_fields
from lyceum_warp.algos.common.networks import Activation
from lyceum_warp.support.docstrings import document_attributes
from lyceum_warp.support.suggestions import suggest_arguments

_BOUNDS: dict[str, float | tuple[float, float]] = {
    "samples": 1, "cg_iterations": 1, "value_epochs": 0, "value_batch": 1, "time_orders": 0, "mean_every": 0,
    "mean_episodes": 1, "gamma": (0.0, 1.0), "lam": (0.0, 1.0), "delta": 0.0, "damping": 0.0,
    "fisher_fraction": (0.0, 1.0), "kl_limit": 1.0, "log_std": LEAST, "min_log_std": LEAST, "value_rate": 0.0,
    "min_restarts": 0.0,
}  # fmt: skip

_LONG_EPISODE = 20
"""If an episode takes more iterations than this limit, NPG restarts worlds by default (``min_restarts``). When an
episode of hopper took 31 or 63 iterations, the return of some seeds stayed low for a long time. This did not happen
when an episode took 16 iterations (bench/README.md, "NPG's learning curves")."""


@suggest_arguments
@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class NPGConfig:
    """Hyperparameters of NPG. The defaults follow Rajeswaran et al., 2017, except as noted.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """

    samples: int | None = None
    """Samples per iteration, rounded up to a multiple of the number of worlds. The default is 16 steps of every world,
    but at least 10,000 samples, as in the paper."""
    rollout: Literal["auto", "episodes", "segments"] = "auto"
    """"episodes" starts new episodes in every iteration, as in the paper. "segments" continues the last iteration's
    episodes, which suits many worlds with few steps each. "auto" selects "episodes" if samples / worlds >= horizon, and
    otherwise "segments"."""
    min_restarts: float | None = None
    """Minimum number of worlds that start an episode in each iteration, as a multiple of samples / horizon; 0 turns
    restarts off. If too few worlds started an episode in the last iteration, NPG restarts random worlds. Restarts
    require "segments" and a time limit. Without restarts, worlds that started together reach the time limit together.
    Until then, few samples come from the start of an episode. The statistics exclude interrupted episodes. A value well
    above 1 therefore biases ``return_mean`` towards short episodes. The default is 0.5 if an episode takes more than 20
    iterations, and 0 otherwise."""
    gamma: float = 0.995
    """Discount factor."""
    lam: float = 0.97
    """Lambda of the generalised advantage estimate."""
    delta: float = 0.1
    """Squared length of a step in the Fisher metric, which is twice the KL divergence between the old and the new
    policy."""
    whiten: bool = True
    """Whether to normalise advantages to mean 0 and standard deviation 1 (as in mjrl, unlike Lyceum)."""
    cg_iterations: int = 10
    """Number of conjugate gradient iterations."""
    damping: float = 1e-4
    """Damping, added to the diagonal of the Fisher information (as in mjrl, unlike Lyceum)."""
    fisher_fraction: float = 1.0
    """Fraction of the samples from which NPG computes the Fisher information. NPG draws these samples at random in each
    iteration."""
    kl_limit: float = 1.5
    """Maximum KL divergence of a step, as a multiple of delta / 2. NPG shortens steps that exceed this limit."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the policy's hidden layers."""
    activation: Activation = "tanh"
    """Activation of the policy's hidden layers."""
    log_std: float = -0.5
    """Initial logarithm of the policy's standard deviations."""
    min_log_std: float = -3.0
    """Lower limit of ``log_std`` during learning (as in mjrl, unlike Lyceum)."""
    value_hidden: tuple[int, ...] = (128, 128)
    """Widths of the value function's hidden layers."""
    value_activation: Activation = "tanh"
    """Activation of the value function's hidden layers."""
    value_group: str | None = None
    """Group of observations for the value function; by default "critic" if the task has this group, else "policy"."""
    value_epochs: int = 2
    """Epochs of the value function's fit."""
    value_batch: int | None = None
    """Mini-batch size of the value function's fit; by default 1/256 of all samples, but at least the paper's 64."""
    value_rate: float = 1e-3
    """Learning rate of the value function's fit (Adam)."""
    time_orders: int = 0
    """Highest power of the value function's time feature; 0 means no time feature."""
    normalize: bool = True
    """Whether to normalise observations by their running mean and variance (unlike the paper)."""
    mean_every: int = 10
    """Iterations between evaluations of the mean policy; 0 means no evaluations."""
    mean_episodes: int = 16
    """Number of episodes in an evaluation of the mean policy."""

    def __post_init__(self) -> None:
        check_fields(self, _BOUNDS)
        if self.fisher_fraction == 0.0:
            raise ValueError("fisher_fraction must be greater than 0, such as 0.1 for every tenth sample")
        if self.log_std < self.min_log_std:
            raise ValueError(f"log_std must be at least min_log_std={self.min_log_std}, not {self.log_std}")


def enough_samples(config: NPGConfig, nworld: int) -> int:
    """Compute the number of samples per iteration; ``nworld`` counts the worlds of all processes."""
    return max(10_000, 16 * nworld) if config.samples is None else config.samples


def least_restarts(config: NPGConfig, nworld: int, steps: int, horizon: int) -> int:
    """Compute how many worlds must start an episode per iteration; ``nworld`` counts the worlds of all processes."""
    if horizon == 0:
        return 0
    share = config.min_restarts
    if share is None:
        share = 0.5 if horizon > _LONG_EPISODE * steps else 0.0
    return round(min(nworld, share * nworld * steps / horizon))
