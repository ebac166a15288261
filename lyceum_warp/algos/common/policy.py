"""Define Gaussian policies with a diagonal covariance and a network that computes the mean."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import torch
from torch import nn

from lyceum_warp.algos.common.hyperparameters import Activation
from lyceum_warp.algos.common.networks import LIMIT, Normalized, check_memory, mlp
from lyceum_warp.algos.common.symmetry import PolicyMirror
from lyceum_warp.core.mirror import Reflection
from lyceum_warp.support.docstrings import document_attributes
from lyceum_warp.support.validate import described, finite_number, layer_sizes, whole_number

_LARGEST = torch.finfo(torch.float32).max


@document_attributes
class GaussianPolicy(Normalized):
    """Samples actions from N(mean(obs), exp(log_std)^2), where log_std does not depend on the observation.

    Example:
        >>> policy = GaussianPolicy(nobs, nact, network=MyNetwork())  # any nn.Module, (..., nobs) -> (..., nact)
        >>> npg = NPG(env, policy)

    Args:
        nobs: Length of an observation.
        nact: Length of an action.
        hidden: Widths of the hidden layers.
        network: A module that replaces the default network. It maps float32 observations (..., nobs) to float32 mean
            actions (..., nact), independently for each observation. If ``normalize`` is set, its inputs are normalised.
            For NPG, the network must be twice differentiable.
        activation: Activation of the hidden layers.
        log_std: Initial logarithm of the standard deviations.
        normalize: Whether to normalise observations by their running mean and variance.
        limit: Normalised observations are clipped to [-limit, limit]; inf means no limit.
        generator: Draws the initial weights.

    Raises:
        ValueError: ``hidden`` is not a sequence of positive whole numbers, ``activation`` is unknown, or ``network`` is
            not a torch module.
    """

    shape: dict[str, Any]
    """Arguments of ``like``."""

    def __init__(
        self,
        nobs: int,
        nact: int,
        hidden: Sequence[int] = (64, 64),
        *,
        network: nn.Module | None = None,
        activation: Activation = "tanh",
        log_std: float = -0.5,
        normalize: bool = False,
        limit: float = LIMIT,
        generator: torch.Generator | None = None,
    ) -> None:
        nobs, nact = whole_number("nobs", nobs, low=1), whole_number("nact", nact, low=1)
        check_memory([nobs, *layer_sizes(hidden), nact])
        super().__init__(nobs, normalize, limit)
        self.nobs, self.nact = nobs, nact
        self.shape = {"nobs": nobs, "nact": nact, "normalize": normalize, "limit": limit}
        if network is None:
            self.shape |= {"hidden": layer_sizes(hidden), "activation": activation}
            # make initial mean actions near zero (as in mjrl)
            network = mlp([nobs, *hidden, nact], activation=activation, last_scale=1e-2, generator=generator)
        elif isinstance(network, nn.Module):
            self.shape["own"] = _class_name(network)
        else:
            raise ValueError(f"network must be a module of torch (torch.nn.Module), not {described(network)}")
        if type(self) is not GaussianPolicy:
            self.shape["own"] = _class_name(self)
        self.network = network
        log_std = finite_number("log_std", log_std, low=-_LARGEST, high=_LARGEST)
        self.log_std = nn.Parameter(torch.full((nact,), log_std))
        self.mirror: PolicyMirror | None = None

    def use_mirror(self, reflections: Mapping[str, Reflection]) -> None:
        """Make the policy symmetric, by averaging over each observation and its mirror image.

        Args:
            reflections: The reflections of ``obs`` and ``action`` (``algos.symmetry.reflections``).
        """
        self.mirror = PolicyMirror(reflections).to(self.log_std.device)
        self.shape["mirror"] = self.mirror.reflections

    @staticmethod
    def like(shape: Mapping[str, Any]) -> "GaussianPolicy":
        """Make a new policy with the given ``shape``.

        Raises:
            ValueError: The policy or its network has a custom class.
        """
        if "own" in shape:
            normalize = ", normalize=True" if shape["normalize"] else ""
            raise ValueError(
                f"the policy has the custom class {shape['own']}: pass a policy of this class, as in lw.load(run, "
                f"policy=lw.GaussianPolicy({shape['nobs']}, {shape['nact']}, network=...{normalize}))"
            )
        policy = GaussianPolicy(**{name: value for name, value in shape.items() if name != "mirror"})
        if "mirror" in shape:
            policy.use_mirror(shape["mirror"])
        return policy

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Compute mean actions, (..., nact)."""
        return self._mean(obs) if self.mirror is None else self.mirror.average(self._mean, obs)

    def _mean(self, obs: torch.Tensor) -> torch.Tensor:
        mean: torch.Tensor = self.network(self.normalizer(obs))
        return mean

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Compute actions without noise, (..., nact): the mean actions."""
        return self(obs)

    @torch.no_grad()
    def sample(self, obs: torch.Tensor, noise: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Sample actions, without gradients.

        Args:
            obs: Observations, (..., nobs).
            noise: Standard normal numbers, (..., nact).
            out: Buffer for the actions, (..., nact).
        """
        return torch.addcmul(self(obs), noise, self.log_std.exp(), out=out)

    def log_prob(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Compute the log-density of actions, (...,)."""
        return log_density(action, self(obs), self.log_std)


def log_density(action: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor) -> torch.Tensor:
    """Compute the log-density of actions under a diagonal Gaussian, (...,)."""
    z = (action - mean) * torch.exp(-log_std)
    return -0.5 * z.square().sum(-1) - log_std.sum() - 0.5 * action.shape[-1] * math.log(2 * math.pi)


def divergence(
    old_mean: torch.Tensor, old_log_std: torch.Tensor, mean: torch.Tensor, log_std: torch.Tensor
) -> torch.Tensor:
    """Compute the KL divergence from one diagonal Gaussian to another, (...,)."""
    square = (old_mean - mean).square() + torch.exp(2 * old_log_std)
    return (log_std - old_log_std + 0.5 * square * torch.exp(-2 * log_std) - 0.5).sum(-1)


Policy: TypeAlias = nn.Module | Callable[[torch.Tensor], torch.Tensor]
"""A module with the method ``act``, or a function from observations to actions."""


def acting(policy: Policy) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return the policy's method ``act``, or the policy itself if it is a function."""
    act: Callable[[torch.Tensor], torch.Tensor] = getattr(policy, "act", policy)
    return act


def _class_name(module: nn.Module) -> str:
    return f"{type(module).__module__}.{type(module).__qualname__}"
