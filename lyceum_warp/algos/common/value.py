"""Define value functions, which predict discounted returns from observations."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos.common.distributed import Team
from lyceum_warp.algos.common.hyperparameters import Activation
from lyceum_warp.algos.common.networks import GRU, LIMIT, Normalized, check_memory, mlp, unrolled
from lyceum_warp.env.env import Env
from lyceum_warp.support.validate import check_group, check_kind, finite_number, layer_sizes, whole_number


class ValueFunction(Normalized):
    """A network that predicts discounted returns.

    Args:
        nobs: Length of an observation.
        hidden: Widths of the hidden layers.
        activation: Activation of the hidden layers.
        scale: Initial factor on the network's output; ``rescale`` later fits the factor to returns.
        time_orders: Highest power of the time features t, t^2, ... with t = step / 1000 (as in mjrl); 0 means no time
            features. Time features help if returns depend on the time that is left in the episode, and observations do
            not contain this time.
        recurrent: Units of a GRU before the hidden layers, which gives the value function memory; 0 means no memory.
        normalize: Whether to normalise observations by their running mean and variance.
        limit: Normalised observations are clipped to [-limit, limit]; inf means no limit.
        discount: Discount factor of the predicted returns, if known.
        group: The group of observations that the value function uses.
        generator: Draws the initial weights.

    Raises:
        ValueError: ``hidden`` is not a sequence of positive whole numbers, or ``activation`` is unknown.
    """

    group: str
    """The group of observations that the value function uses."""
    shift: torch.Tensor
    """The mean of the returns, which is added to the scaled output."""
    scale: torch.Tensor
    """Factor on the network's output: the standard deviation of the returns."""
    discount: float | None
    """Discount factor of the predicted returns, if known."""
    orders: torch.Tensor

    def __init__(
        self,
        nobs: int,
        hidden: Sequence[int] = (128, 128),
        *,
        activation: Activation = "tanh",
        scale: float = 200.0,
        time_orders: int = 0,
        recurrent: int = 0,
        normalize: bool = False,
        limit: float = LIMIT,
        discount: float | None = None,
        group: str = "policy",
        generator: torch.Generator | None = None,
    ) -> None:
        nobs, time_orders = whole_number("nobs", nobs, low=1), whole_number("time_orders", time_orders, low=0)
        recurrent = whole_number("recurrent", recurrent, low=0)
        sizes = [recurrent or nobs + time_orders, *layer_sizes(hidden), 1]
        check_memory(sizes)
        super().__init__(nobs, normalize, limit)
        scale = finite_number("scale", scale)
        check_kind("group", group, str, "as 'policy'")
        self.discount = None if discount is None else finite_number("discount", discount, low=0.0, high=1.0)
        self.group = group
        self._shape = {
            "nobs": nobs, "hidden": layer_sizes(hidden), "activation": activation, "scale": scale,
            "time_orders": time_orders, "normalize": normalize, "limit": limit, "group": group,
        }  # fmt: skip
        self.register_buffer("orders", torch.arange(1.0, time_orders + 1), persistent=False)
        # at first, predict the mean return
        self.network: nn.Module = mlp(sizes, activation=activation, last_scale=0.0, generator=generator)
        if recurrent:
            self._shape["recurrent"] = self.state_size = recurrent
            self.network = GRU(nobs + time_orders, recurrent, self.network, generator)
        self.register_buffer("shift", torch.zeros((), dtype=torch.float64))
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float64))

    @property
    def shape(self) -> dict[str, Any]:
        """Arguments that make a value function with the same structure."""
        return self._shape | {"discount": self.discount}

    def features(self, obs: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """Compute the network's input, (..., nobs + time_orders).

        Args:
            obs: Observations, (..., nobs).
            step: Steps since the reset, (...,).
        """
        obs = self.normalizer(obs)
        if not len(self.orders):
            return obs
        time = (step.unsqueeze(-1) * 1e-3) ** self.orders
        return torch.cat([obs, time], dim=-1)

    def forward(self, obs: torch.Tensor, step: torch.Tensor, state: torch.Tensor | None = None) -> torch.Tensor:
        """Predict discounted returns, (...,). A value function with memory needs its state, (..., state_size)."""
        x = self.features(obs, step)
        if not self.state_size:
            return self._scaled(self.network(x))
        assert state is not None
        output, _ = self.network(x.flatten(0, -2), state.flatten(0, -2))
        return self._scaled(output).view(step.shape)

    def _scaled(self, output: torch.Tensor) -> torch.Tensor:
        return output.squeeze(-1) * self.scale.float() + self.shift.float()

    def unrolled(
        self, obs: torch.Tensor, step: torch.Tensor, state: torch.Tensor, began: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Predict discounted returns along sequences; see ``networks.unrolled``.

        Returns:
            The predictions (steps, n), and the states after each step, (steps, n, state_size).
        """
        if not self.state_size:
            return self(obs, step), state.expand(len(obs), *state.shape)
        output, states = unrolled(self.network, self.features(obs, step), state, began)
        return self._scaled(output), states

    @torch.no_grad()
    def rescale(self, returns: torch.Tensor, *, first: bool = False, team: Team | None = None) -> None:
        """Set shift and scale to the mean and standard deviation of returns, without changing the predictions.

        The last layer compensates for the change (Pop-Art; van Hasselt et al. 2016, "Learning values across many orders
        of magnitude"). Returns are clipped to the old shift plus or minus ``BOUND`` times the old scale, and the scale
        changes at most by the factor ``BOUND``. These limits do not apply if more than a quarter of the returns are
        outliers, for example after a change of the task. The quartiles of the returns then determine the bounds of the
        returns, and the scale may change by any factor. If all returns are equal, the scale does not change.

        Args:
            returns: Returns, of any shape.
            first: Whether the value function is new; its scale is then arbitrary.
            team: The processes; each contributes the same number of returns.
        """
        team = team or Team()
        returns = returns.flatten().double()
        count = len(returns) * team.size
        low, high = self.shift - BOUND * self.scale, self.shift + BOUND * self.scale
        beyond = team.sum(((returns < low) | (returns > high)).double().sum())
        new = (beyond > 0.25 * count) | first
        ordered = team.gather(returns).nan_to_num().sort().values
        last = len(ordered) - 1
        quartile, median, third = ordered[last // 4], ordered[2 * last // 4], ordered[3 * last // 4]
        width = 20.0 * (third - quartile)
        width.masked_fill_(width == 0.0, torch.inf)  # quartiles may be equal, for example with sparse rewards
        low, high = torch.where(new, median - width, low), torch.where(new, median + width, high)
        returns = torch.minimum(torch.maximum(returns, low), high).nan_to_num()
        mean = team.sum(returns.sum()) / count
        std = (team.sum((returns - mean).square().sum()) / count).sqrt()
        # ignore float32 rounding
        scale = torch.where(std > 1e-6 * mean.abs(), torch.maximum(std, 1e-3 * mean.abs()), self.scale)
        limited = torch.minimum(torch.maximum(scale, self.scale / BOUND), self.scale * BOUND)
        scale = torch.where(new, scale, limited)
        layer = self.network[-1]  # type: ignore[index]
        assert isinstance(layer, nn.Linear)
        layer.weight.mul_(self.scale / scale)
        layer.bias.copy_((layer.bias * self.scale + self.shift - mean) / scale)
        self.shift.copy_(mean)
        self.scale.copy_(scale)


BOUND = 10.0
"""The limit for outliers, in standard deviations of the returns.

A return is an outlier if it is further than this from the mean return. An advantage is an outlier if its absolute value
is larger than this.
"""


def value_group(env: Env, name: str | None) -> str:
    """Select a value function's observations: by default the group "critic" if it exists, else "policy".

    Raises:
        ValueError: The task has no observation group of this name.
    """
    group = name or ("critic" if "critic" in env.obs_groups else "policy")
    check_group(group, env.worlds.obs_spaces, env.task.name)  # without cameras
    return group
