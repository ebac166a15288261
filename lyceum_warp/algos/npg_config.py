"""Hyperparameters of NPG."""

import dataclasses
from typing import Literal

from lyceum_warp.algos.hyperparameters import LEAST, check_fields
from lyceum_warp.algos.networks import Activation
from lyceum_warp.support.docstrings import document_attributes

_BOUNDS: dict[str, float | tuple[float, float]] = {
    "samples": 1, "cg_iterations": 1, "value_epochs": 0, "value_batch": 1, "time_orders": 0, "mean_every": 0,
    "mean_episodes": 1, "gamma": (0.0, 1.0), "lam": (0.0, 1.0), "delta": 0.0, "damping": 0.0,
    "fisher_fraction": (0.0, 1.0), "kl_limit": 1.0, "log_std": LEAST, "min_log_std": LEAST, "value_rate": 0.0,
    "min_restarts": 0.0,
}  # fmt: skip

_LONG_EPISODE = 20
"""Restarts are on by default if an episode lasts longer than this number of iterations. On a few seeds of hopper, NPG's
return stayed low for long at 63 and 31 iterations and not at 16 (bench/README.md, "NPG's learning curves")."""


@document_attributes
@dataclasses.dataclass(frozen=True, kw_only=True)
class NPGConfig:
    """Hyperparameters of NPG. The defaults are those of Rajeswaran et al. (2017), where nothing else is said.

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """

    samples: int | None = None
    """Samples in an iteration, rounded up to whole steps of all worlds; by default the paper's 10,000, or 16 steps of
    every world where those are more."""
    rollout: Literal["auto", "episodes", "segments"] = "auto"
    """"episodes" begins new episodes in every iteration, as in the paper; "segments" continues those of the last
    iteration, for many worlds and few steps of each; "auto" selects episodes where whole ones fit, that is where
    samples / worlds >= horizon."""
    min_restarts: float | None = None
    """With segments and a time limit, the number of worlds that should begin an episode in an iteration, as a multiple
    of samples / horizon, the average where no episode ends early. If fewer worlds than this began an episode in the
    last iteration, random further ones restart before the next. The episodes that this cuts off do not count in the
    statistics; values well above 1 cut off so many long ones that ``return_mean`` favours short ones. Without such
    restarts, worlds that began at about the same time reach the time limit together, and meanwhile few samples show
    how episodes begin. 0 means no such restarts. The default is 0.5 if an episode lasts longer than 20 iterations, as
    with 205 or more worlds, 1,000 steps and the default samples, and 0 otherwise."""
    gamma: float = 0.995
    """Discount."""
    lam: float = 0.97
    """Decay of the generalised advantage estimate."""
    delta: float = 0.1
    """Squared length of a step in the Fisher metric: twice the KL divergence between old and new policy."""
    whiten: bool = True
    """Whether to scale the advantages to mean 0 and standard deviation 1 (as mjrl, unlike Lyceum)."""
    cg_iterations: int = 10
    """Iterations of conjugate gradient."""
    damping: float = 1e-4
    """Added to the diagonal of the Fisher information (as mjrl; Lyceum has none)."""
    fisher_fraction: float = 1.0
    """Share of the samples that the Fisher information is averaged over, drawn at random in each iteration."""
    kl_limit: float = 1.5
    """Largest KL divergence of a step, as a multiple of delta / 2, its value to second order. A step that exceeds it
    is shortened."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the policy's hidden layers."""
    activation: Activation = "tanh"
    """What follows each of the policy's hidden layers."""
    log_std: float = -0.5
    """Initial logarithm of the policy's standard deviations."""
    min_log_std: float = -3.0
    """Lower limit of the logarithm of the policy's standard deviations (as mjrl; Lyceum has none)."""
    value_hidden: tuple[int, ...] = (128, 128)
    """Widths of the value function's hidden layers."""
    value_activation: Activation = "tanh"
    """What follows each of the value function's hidden layers."""
    value_group: str | None = None
    """Group of observations that the value function gets; by default "critic" where the task has such a group, else
    "policy"."""
    value_epochs: int = 2
    """Passes over the samples when the value function is fitted."""
    value_batch: int | None = None
    """Samples in a mini-batch of the value function's fit; by default a 256th of all samples, but at least the paper's
    64, so that more samples cost no more steps."""
    value_rate: float = 1e-3
    """Learning rate of the value function's fit (Adam)."""
    time_orders: int = 0
    """Highest power of the value function's time feature; 0 for none."""
    normalize: bool = True
    """Whether policy and value function normalise observations by their running mean and variance (unlike the
    paper)."""
    mean_every: int = 10
    """Iterations between two evaluations of the mean policy; 0 for never."""
    mean_episodes: int = 16
    """Episodes in an evaluation of the mean policy."""

    def __post_init__(self) -> None:
        """Check every value."""
        check_fields(self, _BOUNDS)
        if self.fisher_fraction == 0.0:
            raise ValueError("fisher_fraction must be greater than 0, as in 0.1 for every tenth sample")
        if self.log_std < self.min_log_std:
            raise ValueError(f"log_std must not be below min_log_std, which is {self.min_log_std}, not {self.log_std}")


def enough_samples(config: NPGConfig, nworld: int) -> int:
    """Samples in an iteration of ``nworld`` worlds, those of all processes."""
    return max(10_000, 16 * nworld) if config.samples is None else config.samples


def least_restarts(config: NPGConfig, nworld: int, steps: int, horizon: int) -> int:
    """The number of worlds that should begin an episode in an iteration, of those of all processes.

    Args:
        config: The hyperparameters.
        nworld: Worlds of all processes.
        steps: Steps of each world in an iteration.
        horizon: Steps of an episode; 0 where the task has no time limit.
    """
    if horizon == 0:
        return 0
    share = config.min_restarts
    if share is None:
        share = 0.5 if horizon > _LONG_EPISODE * steps else 0.0
    return min(nworld, round(share * nworld * steps / horizon))
