"""Policies: a diagonal Gaussian around a small network."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos.distributed import Team
from lyceum_warp.validate import layer_sizes


def mlp(sizes: Sequence[int], *, last_scale: float = 1.0, generator: torch.Generator | None = None) -> nn.Sequential:
    """A tanh network with Glorot-uniform weights and zero biases; the last layer's weights are scaled."""
    layers: list[nn.Module] = []
    for i, (n, m) in enumerate(itertools.pairwise(sizes)):
        linear = nn.Linear(n, m)
        nn.init.xavier_uniform_(linear.weight, gain=1.0, generator=generator)
        nn.init.zeros_(linear.bias)
        layers.append(linear)
        if i < len(sizes) - 2:
            layers.append(nn.Tanh())
    with torch.no_grad():
        linear.weight.mul_(last_scale)
    return nn.Sequential(*layers)


class Normalizer(nn.Module):
    """Running mean and variance of observations; the identity until the first update.

    Args:
        size: Numbers in an observation.
        limit: Normalised values are clipped to plus and minus this.
    """

    count: torch.Tensor
    mean: torch.Tensor
    square: torch.Tensor
    shift: torch.Tensor
    scale: torch.Tensor

    def __init__(self, size: int, limit: float = 10.0) -> None:
        super().__init__()
        self.limit = limit
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("square", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    @torch.no_grad()
    def update(self, obs: torch.Tensor, team: Team | None = None) -> None:
        """Take in (..., size) observations, as many of each process (Chan et al. 1983, parallel mean and variance)."""
        team = team or Team()
        obs = obs.reshape(-1, obs.shape[-1]).double()
        n = obs.shape[0] * team.size
        mean = team.sum(obs.sum(0)) / n
        square = team.sum((obs - mean).square().sum(0))
        total, delta = self.count + n, mean - self.mean
        self.square += square + delta.square() * (self.count * n / total)
        self.mean += delta * (n / total)
        self.count.copy_(total)
        self.shift.copy_(self.mean)
        self.scale.copy_((self.square / total).sqrt().clamp_min(1e-4).reciprocal())

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Normalised observations."""
        return ((obs - self.shift) * self.scale).clamp(-self.limit, self.limit)


class GaussianPolicy(nn.Module):
    """Actions from N(mean(obs), exp(log_std)^2), with a log_std that does not depend on the observation.

    Args:
        nobs: Numbers in an observation.
        nact: Numbers in an action.
        hidden: Widths of the hidden layers.
        log_std: Initial logarithm of the standard deviations.
        normalize: Whether to normalise observations by their running mean and variance.
        generator: Draws the initial weights.
    """

    shape: dict[str, Any]
    """The arguments that make another one for the same weights."""

    def __init__(
        self,
        nobs: int,
        nact: int,
        hidden: Sequence[int] = (64, 64),
        *,
        log_std: float = -0.5,
        normalize: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.nobs, self.nact = nobs, nact
        self.shape = {"nobs": nobs, "nact": nact, "hidden": layer_sizes(hidden), "normalize": normalize}
        self.normalizer: nn.Module = Normalizer(nobs) if normalize else nn.Identity()
        # a last layer near zero starts every mean near the middle of its range (mjrl)
        self.network = mlp([nobs, *hidden, nact], last_scale=1e-2, generator=generator)
        self.log_std = nn.Parameter(torch.full((nact,), float(log_std)))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Mean actions, (..., nact)."""
        return self.network(self.normalizer(obs))

    @torch.no_grad()
    def sample(self, obs: torch.Tensor, noise: torch.Tensor, out: torch.Tensor) -> torch.Tensor:
        """Random actions from standard normal noise, written into ``out``; all (..., nact) but ``obs``."""
        return torch.addcmul(self(obs), noise, self.log_std.exp(), out=out)

    def log_prob(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Log-density of actions, (...,)."""
        z = (action - self(obs)) * torch.exp(-self.log_std)
        return -0.5 * z.square().sum(-1) - self.log_std.sum() - 0.5 * action.shape[-1] * math.log(2 * math.pi)
