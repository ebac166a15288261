"""When rsl_rl's normalisers take in observations, and how without waiting for the device."""

from collections.abc import Mapping
from typing import Any

import torch


def freeze_normalizers(ppo: Any) -> None:
    """Keep PPO from updating its normalisers: releases of rsl_rl do so in different places."""
    for network in (ppo.actor, ppo.critic):
        network.obs_normalizer.eval()


@torch.no_grad()
def take_in(network: Any, obs: Mapping[str, torch.Tensor]) -> None:
    """Take observations into a network's normaliser, as ``MLPModel.update_normalization`` of rsl_rl does.

    rsl_rl's own copies a number from the host, which waits for the device, and replaces the buffer of the standard
    deviation, which a captured graph reads at its address.

    Args:
        network: An MLPModel of rsl_rl; nothing happens where it does not normalise.
        obs: Observations by their groups, each (..., size of the group).
    """
    if not network.obs_normalization:
        return
    normalizer = network.obs_normalizer
    rows = torch.cat([obs[group] for group in network.obs_groups], dim=-1)
    rows = rows.reshape(-1, rows.shape[-1])
    variance, mean = torch.var_mean(rows, dim=0, correction=0, keepdim=True)
    normalizer.count.add_(len(rows))
    rate = len(rows) / normalizer.count
    change = mean - normalizer._mean
    normalizer._mean.add_(rate * change)
    normalizer._var.add_(rate * (variance - normalizer._var + change * (mean - normalizer._mean)))
    torch.sqrt(normalizer._var, out=normalizer._std)
