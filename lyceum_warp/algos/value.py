"""Value functions: predictions of the discounted return from a state."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos.networks import Activation, Normalizer, mlp
from lyceum_warp.docstrings import document_attributes
from lyceum_warp.validate import layer_sizes


@document_attributes
class ValueFunction(nn.Module):
    """A network that predicts discounted returns.

    Args:
        nobs: Numbers in an observation.
        hidden: Widths of the hidden layers.
        activation: What follows each hidden layer.
        scale: Factor of the network's output, which keeps that output of order one: 1 / (1 - gamma) for rewards of
            order one.
        time_orders: Highest power of the time feature; 0 for none. A time limit that the observation does not show
            makes the return depend on the step; the features t, t^2, ... with t = step / 1000 show it (mjrl).
        normalize: Whether to normalise observations by their running mean and variance.
        discount: The discount of the returns that it is fitted to, where known.
        generator: Draws the initial weights.

    Raises:
        ValueError: ``hidden`` is not a sequence of positive whole numbers, or ``activation`` is not a known name.
    """

    discount: float | None
    """The discount of the returns that it was fitted to, where known."""
    orders: torch.Tensor
    """The powers of the time feature, (time_orders,)."""

    def __init__(
        self,
        nobs: int,
        hidden: Sequence[int] = (128, 128),
        *,
        activation: Activation = "tanh",
        scale: float = 200.0,
        time_orders: int = 0,
        normalize: bool = False,
        discount: float | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.scale, self.discount = scale, discount
        self._shape = {
            "nobs": nobs, "hidden": layer_sizes(hidden), "activation": activation, "scale": scale,
            "time_orders": time_orders, "normalize": normalize,
        }  # fmt: skip
        self.normalizer: nn.Module = Normalizer(nobs) if normalize else nn.Identity()
        self.register_buffer("orders", torch.arange(1.0, time_orders + 1), persistent=False)
        self.network = mlp([nobs + time_orders, *hidden, 1], activation=activation, generator=generator)

    @property
    def shape(self) -> dict[str, Any]:
        """The arguments of a value function that takes the same weights."""
        return self._shape | {"discount": self.discount}

    def features(self, obs: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """The network's input, (..., nobs + time_orders).

        Args:
            obs: Observations, (..., nobs).
            step: Steps since the reset, (...,).
        """
        obs = self.normalizer(obs)
        if not len(self.orders):
            return obs
        time = (step.unsqueeze(-1) * 1e-3) ** self.orders
        return torch.cat([obs, time], dim=-1)

    def forward(self, obs: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Predicted returns, (...,)."""
        return self.network(self.features(obs, step)).squeeze(-1) * self.scale
