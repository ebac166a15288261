"""Define SAC's policies: a bounded action is the hyperbolic tangent of a Gaussian sample, scaled to the bounds."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from lyceum_warp.algos.common.hyperparameters import Activation
from lyceum_warp.algos.common.networks import LIMIT, Normalized, check_memory, initialize_as_torch, mlp
from lyceum_warp.algos.common.symmetry import PolicyMirror
from lyceum_warp.core.mirror import Reflection
from lyceum_warp.support.validate import layer_sizes, whole_number

_LOWEST, _HIGHEST = -5.0, 2.0
"""Bounds of the logarithm of the standard deviations."""


class SquashedPolicy(Normalized):
    """Samples bounded actions: low + (high - low) (1 + tanh(u)) / 2 with u from N(mean(obs), std(obs)^2).

    One network computes both the means and the logarithms of the standard deviations (Haarnoja et al. 2018, "Soft
    Actor-Critic Algorithms and Applications", appendix C). The *unit action* is tanh(u), between -1 and 1.

    Args:
        nobs: Length of an observation.
        nact: Length of an action.
        hidden: Widths of the hidden layers.
        low: Lower bounds of the actions, (nact,).
        high: Upper bounds of the actions, (nact,).
        activation: Activation of the hidden layers.
        normalize: Whether to normalise observations by their running mean and variance.
        limit: Normalised observations are clipped to [-limit, limit]; inf means no limit.
        mirror: The argument of ``use_mirror``, to make the policy symmetric.
        generator: Draws the initial weights.

    Raises:
        ValueError: The bounds of an action differ from those of its mirror image.
    """

    shape: dict[str, Any]
    """Arguments that make a policy with the same structure."""
    low: torch.Tensor
    """Lower bounds of the actions, (nact,)."""
    width: torch.Tensor
    """Differences between the upper and lower bounds, (nact,)."""

    def __init__(
        self,
        nobs: int,
        nact: int,
        hidden: Sequence[int] = (256, 256),
        *,
        low: Sequence[float],
        high: Sequence[float],
        activation: Activation = "relu",
        normalize: bool = False,
        limit: float = LIMIT,
        mirror: Mapping[str, Reflection] | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        nobs, nact = whole_number("nobs", nobs, low=1), whole_number("nact", nact, low=1)
        sizes = [nobs, *layer_sizes(hidden), 2 * nact]
        check_memory(sizes)
        super().__init__(nobs, normalize, limit)
        self.nobs, self.nact = nobs, nact
        self.shape = {
            "nobs": nobs, "nact": nact, "hidden": layer_sizes(hidden), "low": [float(x) for x in low],
            "high": [float(x) for x in high], "activation": activation, "normalize": normalize, "limit": limit,
        }  # fmt: skip
        self.network = mlp(sizes, activation=activation, generator=generator)
        initialize_as_torch(self.network, generator)
        self.register_buffer("low", torch.tensor(self.shape["low"]))
        self.register_buffer("width", torch.tensor(self.shape["high"]) - torch.tensor(self.shape["low"]))
        self.mirror: PolicyMirror | None = None
        if mirror is not None:
            self.use_mirror(mirror)

    def use_mirror(self, reflections: Mapping[str, Reflection]) -> None:
        """Make the policy symmetric: average its mean and standard deviation with those of its mirror image.

        Args:
            reflections: The reflections of ``obs`` and ``action`` (``algos.symmetry.reflections``).

        Raises:
            ValueError: The bounds of an action differ from those of its mirror image.
        """
        low, high = self.shape["low"], self.shape["high"]
        bounds = list(zip(low, high, strict=True))
        order, signs = reflections["action"]
        images = [bounds[i] if sign > 0 else (-high[i], -low[i]) for i, sign in zip(order, signs, strict=True)]
        if images != bounds:
            raise ValueError(
                f"the actions from {low} to {high} have different bounds than their mirror images: learn with "
                'symmetry="none"'
            )
        self.mirror = PolicyMirror(reflections).to(self.low.device)
        self.shape["mirror"] = self.mirror.reflections

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Compute the Gaussian's means and the logarithms of its standard deviations, each (..., nact)."""
        mean, spread = self._outputs(obs)
        if self.mirror is not None:
            image, image_spread = self._outputs(self.mirror.obs(obs))
            mean = 0.5 * (mean + self.mirror.action(image))
            spread = 0.5 * (spread + self.mirror.action.swapped(image_spread))
        return mean, _LOWEST + 0.5 * (_HIGHEST - _LOWEST) * (1.0 + torch.tanh(spread))

    def _outputs(self, obs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return self.network(self.normalizer(obs)).float().chunk(2, dim=-1)  # float32 even under autocast

    def act(self, obs: torch.Tensor) -> torch.Tensor:
        """Compute actions without noise, (..., nact)."""
        return self.scaled(torch.tanh(self(obs)[0]))

    def sample(self, obs: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Sample unit actions, (..., nact), and compute their log-densities, (...,).

        Args:
            obs: Observations, (..., nobs).
            noise: Standard normal numbers, (..., nact).
        """
        mean, log_std = self(obs)
        u = mean + log_std.exp() * noise
        # log(1 - tanh(u)^2), without loss of precision for large u
        slope = 2.0 * (math.log(2.0) - u - torch.nn.functional.softplus(-2.0 * u))
        gaussian = -0.5 * noise.square() - log_std - 0.5 * math.log(2.0 * math.pi)
        return torch.tanh(u), (gaussian - slope).sum(-1)

    def scaled(self, unit: torch.Tensor) -> torch.Tensor:
        """Scale actions from the range [-1, 1] to the action bounds."""
        return self.low + 0.5 * self.width * (1.0 + unit)

    def unit(self, action: torch.Tensor) -> torch.Tensor:
        """Scale actions from the action bounds to the range [-1, 1]."""
        return 2.0 * (action - self.low) / self.width - 1.0
