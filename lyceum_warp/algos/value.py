"""Value functions: what a state is worth, fitted by regression on returns."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos.policy import Normalizer, mlp


class ValueFunction(nn.Module):
    """A network that predicts discounted returns.

    Args:
        nobs: Numbers in an observation.
        hidden: Widths of the hidden layers.
        scale: What the network's output is multiplied by, so that it stays of order one; 1 / (1 - gamma) for
            rewards of order one.
        time_orders: Highest power of the time feature; 0 for none. A time limit that the observation does not
            show makes the return depend on the step, which the features t, t^2, ... with t = step / 1000 do
            show (mjrl).
        normalize: Whether to normalise observations by their running mean and variance.
        generator: Draws the initial weights.
    """

    shape: dict[str, Any]
    """The arguments that make another one for the same weights."""
    orders: torch.Tensor

    def __init__(
        self,
        nobs: int,
        hidden: Sequence[int] = (128, 128),
        *,
        scale: float = 200.0,
        time_orders: int = 0,
        normalize: bool = False,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.scale = scale
        self.shape = {
            "nobs": nobs, "hidden": list(hidden), "scale": scale, "time_orders": time_orders, "normalize": normalize,
        }  # fmt: skip
        self.normalizer: nn.Module = Normalizer(nobs) if normalize else nn.Identity()
        self.register_buffer("orders", torch.arange(1.0, time_orders + 1), persistent=False)
        self.network = mlp([nobs + time_orders, *hidden, 1], generator=generator)

    def features(self, obs: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """The network's input, (..., nobs + time_orders), for observations made ``step`` steps after a reset."""
        obs = self.normalizer(obs)
        if not len(self.orders):
            return obs
        time = (step.unsqueeze(-1) * 1e-3) ** self.orders
        return torch.cat([obs, time], dim=-1)

    def forward(self, obs: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Predicted returns, (...,)."""
        return self.network(self.features(obs, step)).squeeze(-1) * self.scale
