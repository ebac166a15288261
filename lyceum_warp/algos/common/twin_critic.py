"""Define twin critics, two networks that predict discounted returns from observations and actions.

The critics can predict quantiles of the returns (Dabney et al. 2018, "Distributional Reinforcement Learning with
Quantile Regression").
"""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos.common.hyperparameters import Activation
from lyceum_warp.algos.common.networks import ACTIVATIONS, LIMIT, Normalized, check_memory
from lyceum_warp.support.validate import check_word, layer_sizes, whole_number


class TwinCritic(Normalized):
    """Two independent networks of the same shape, evaluated together.

    Args:
        nobs: Length of an observation.
        nact: Length of an action.
        hidden: Widths of the hidden layers.
        activation: Activation of the hidden layers.
        layer_norm: Whether to normalise each hidden layer before its activation (Ba et al. 2016, "Layer
            Normalization").
        quantiles: Number of quantiles that each critic predicts; with 1, it predicts the mean.
        normalize: Whether to normalise observations by their running mean and variance.
        limit: Normalised observations are clipped to [-limit, limit]; inf means no limit.
        group: The group of observations that the critics use.
        generator: Draws the initial weights.
    """

    shape: dict[str, Any]
    """Constructor arguments of critics with the same structure."""
    group: str
    """The group of observations that the critics use."""

    def __init__(
        self,
        nobs: int,
        nact: int,
        hidden: Sequence[int] = (256, 256),
        *,
        activation: Activation = "relu",
        layer_norm: bool = True,
        quantiles: int = 1,
        normalize: bool = False,
        limit: float = LIMIT,
        group: str = "policy",
        generator: torch.Generator | None = None,
    ) -> None:
        nobs, nact = whole_number("nobs", nobs, low=1), whole_number("nact", nact, low=1)
        sizes = [nobs + nact, *layer_sizes(hidden), whole_number("quantiles", quantiles, low=1)]
        check_word("activation", activation, list(ACTIVATIONS))
        check_memory(sizes, networks=2)
        super().__init__(nobs, normalize, limit)
        self.group = group
        self.nobs, self.nact = nobs, nact
        self.shape = {
            "nobs": nobs, "nact": nact, "hidden": layer_sizes(hidden), "activation": activation,
            "layer_norm": layer_norm, "quantiles": quantiles, "normalize": normalize, "limit": limit, "group": group,
        }  # fmt: skip
        layers: list[nn.Module] = []
        for i, (n, m) in enumerate(itertools.pairwise(sizes)):
            layers.append(TwinLinear(n, m, generator))
            if i < len(sizes) - 2:
                layers += [TwinLayerNorm(m)] if layer_norm else []
                layers.append(ACTIVATIONS[activation]())
        self.network = nn.Sequential(*layers)

    def forward(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Predict discounted returns, (2, rows).

        Args:
            obs: Observations, (rows, nobs).
            action: Unit actions, between -1 and 1, (rows, nact).
        """
        return self.quantiles(obs, action).mean(-1)

    def quantiles(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """Predict quantiles of discounted returns, (2, rows, quantiles). The arguments are those of ``forward``."""
        x = torch.cat([self.normalizer(obs), action], dim=-1).expand(2, -1, -1)
        values: torch.Tensor = self.network(x)
        return values.float()


def quantile_loss(values: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Compute the quantile Huber loss of each row (Dabney et al. 2018, equation 10), summed over both critics.

    Args:
        values: The critics' quantiles, (2, rows, n).
        target: Samples of the target, (rows, m).
    """
    n = values.shape[-1]
    fraction = ((torch.arange(n, device=values.device) + 0.5) / n)[:, None]
    error = target[:, None, :] - values[..., None]
    huber = nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none")
    return ((fraction - (error.detach() < 0).float()).abs() * huber).mean((-2, -1)).sum(0)


class TwinLinear(nn.Module):
    """Two linear layers, from (2, rows, n) to (2, rows, m), initialised like ``nn.Linear``."""

    def __init__(self, n: int, m: int, generator: torch.Generator | None) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(n)
        self.weight = nn.Parameter(torch.empty(2, n, m).uniform_(-bound, bound, generator=generator))
        self.bias = nn.Parameter(torch.empty(2, 1, m).uniform_(-bound, bound, generator=generator))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Apply both layers."""
        return torch.baddbmm(self.bias, x, self.weight)


class TwinLayerNorm(nn.Module):
    """Normalises inputs of the two critics, (2, rows, m), with a separate gain and shift for each critic."""

    def __init__(self, m: int) -> None:
        super().__init__()
        self.gain, self.shift = nn.Parameter(torch.ones(2, 1, m)), nn.Parameter(torch.zeros(2, 1, m))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Normalise each row."""
        return torch.addcmul(self.shift, nn.functional.layer_norm(x, x.shape[-1:]), self.gain)
