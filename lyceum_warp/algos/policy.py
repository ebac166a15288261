"""Policies: a diagonal Gaussian around a small network."""

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos.networks import Activation, Normalizer, mlp
from lyceum_warp.docstrings import document_attributes
from lyceum_warp.validate import layer_sizes


@document_attributes
class GaussianPolicy(nn.Module):
    """Actions from N(mean(obs), exp(log_std)^2), with a log_std that does not depend on the observation.

    Args:
        nobs: Numbers in an observation.
        nact: Numbers in an action.
        hidden: Widths of the hidden layers.
        activation: What follows each hidden layer.
        log_std: Initial logarithm of the standard deviations.
        normalize: Whether to normalise observations by their running mean and variance.
        generator: Draws the initial weights.

    Raises:
        ValueError: ``hidden`` is not a sequence of positive whole numbers, or ``activation`` is not a known name.
    """

    shape: dict[str, Any]
    """The arguments of a policy that takes the same weights."""

    def __init__(
        self,
        nobs: int,
        nact: int,
        hidden: Sequence[int] = (64, 64),
        *,
        activation: Activation = "tanh",
        log_std: float = -0.5,
        normalize: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.nobs, self.nact = nobs, nact
        self.shape = {
            "nobs": nobs, "nact": nact, "hidden": layer_sizes(hidden), "activation": activation, "normalize": normalize,
        }  # fmt: skip
        self.normalizer: nn.Module = Normalizer(nobs) if normalize else nn.Identity()
        # a last layer near zero starts every mean near the middle of its range (mjrl)
        self.network = mlp([nobs, *hidden, nact], activation=activation, last_scale=1e-2, generator=generator)
        self.log_std = nn.Parameter(torch.full((nact,), float(log_std)))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Mean actions, (..., nact)."""
        return self.network(self.normalizer(obs))

    @torch.no_grad()
    def sample(self, obs: torch.Tensor, noise: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Draw actions, without gradients.

        Args:
            obs: Observations, (..., nobs).
            noise: Standard normal numbers, (..., nact).
            out: Where to write the actions, (..., nact).
        """
        return torch.addcmul(self(obs), noise, self.log_std.exp(), out=out)

    def log_prob(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Log-density of actions, (...,)."""
        z = (action - self(obs)) * torch.exp(-self.log_std)
        return -0.5 * z.square().sum(-1) - self.log_std.sum() - 0.5 * action.shape[-1] * math.log(2 * math.pi)
