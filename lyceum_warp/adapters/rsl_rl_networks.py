"""Networks of rsl_rl as those of this package, and back: runs then hold policies that need no rsl_rl."""

import math
from typing import Any

import torch
from torch import nn

from lyceum_warp.algos.networks import Normalizer
from lyceum_warp.algos.policy import GaussianPolicy
from lyceum_warp.algos.value import ValueFunction
from lyceum_warp.env import Env

ENDLESS = {"limit": math.inf}
"""rsl_rl does not clip normalised observations."""


@torch.no_grad()
def copy_policy(actor: Any, policy: GaussianPolicy) -> None:
    """Give a policy the weights of an actor, so that both have the same mean actions and standard deviations.

    Args:
        actor: An MLPModel of rsl_rl with a GaussianDistribution.
        policy: A policy of the same sizes, whose normaliser has no limit.
    """
    policy.network.load_state_dict(actor.mlp.state_dict())
    _copy_statistics(actor.obs_normalizer, policy.normalizer)
    distribution = actor.distribution
    if distribution.std_type == "log":
        log_std = distribution.log_std_param.clamp(*distribution.log_std_range)
    else:
        log_std = distribution.std_param.clamp(*distribution.std_range).log()
    policy.log_std.copy_(log_std)


@torch.no_grad()
def copy_value(critic: Any, value: ValueFunction) -> None:
    """Give a value function the weights of a critic, so that both have the same values.

    Args:
        critic: An MLPModel of rsl_rl.
        value: A value function of the same sizes, of scale 1, whose normaliser has no limit.
    """
    value.network.load_state_dict(critic.mlp.state_dict())
    _copy_statistics(critic.obs_normalizer, value.normalizer)


@torch.no_grad()
def begin_with(actor: Any, critic: Any, policy: GaussianPolicy, value: ValueFunction | None) -> None:
    """Give an actor and a critic of the same sizes the weights of a policy and of a value function."""
    actor.mlp.load_state_dict(policy.network.state_dict())
    _begin_with_statistics(actor.obs_normalizer, policy.normalizer)
    distribution = actor.distribution
    if distribution.std_type == "log":
        distribution.log_std_param.copy_(policy.log_std)
    else:
        distribution.std_param.copy_(policy.log_std.exp())
    if value is None:
        return
    critic.mlp.load_state_dict(value.network.state_dict())
    last = critic.mlp[-1]  # rsl_rl's critic has neither scale nor shift
    last.weight.mul_(value.scale)
    last.bias.copy_(last.bias * value.scale + value.shift)
    _begin_with_statistics(critic.obs_normalizer, value.normalizer)


def check_networks(policy: GaussianPolicy, value: ValueFunction | None, env: Env) -> None:
    """Check that rsl_rl's networks can take the weights of a policy and of a value function.

    Args:
        policy: The policy.
        value: The value function, if there is one.
        env: The environment in which they learn.

    Raises:
        ValueError: One of them does something that rsl_rl's networks cannot do, or has other sizes than the
            environment.
    """
    sizes, wanted = (policy.nobs, policy.nact), (env.obs_space.size, env.action_space.size)
    if sizes != wanted:
        raise ValueError(
            f"the policy takes {sizes[0]} observations and gives {sizes[1]} actions, but the task {env.task.name!r} "
            f"has {wanted[0]} and {wanted[1]}"
        )
    if "own" in policy.shape:
        raise ValueError(f"rsl_rl's PPO cannot begin with a policy of a class of its own, {policy.shape['own']}")
    for name, module in (("policy", policy), ("value function", value)):
        limit = getattr(module.normalizer, "limit", math.inf) if module is not None else math.inf
        if limit != math.inf:
            raise ValueError(
                f"the {name} clips normalised observations at {limit:g}, which rsl_rl's networks do not: begin with "
                "those of a run of rsl-rl, or of one that was trained with normalize=False"
            )
    if value is None:
        return
    if value.shape["time_orders"]:
        raise ValueError("the value function has time features (time_orders), which rsl_rl's networks do not have")
    if value.shape["normalize"] != policy.shape["normalize"]:
        raise ValueError("policy and value function must both normalise observations, or neither of them")
    space = env.obs_spaces.get(value.group)
    if space is None or space.size != value.shape["nobs"]:
        groups = ", ".join(f"{name!r} of {found.size}" for name, found in env.obs_spaces.items())
        raise ValueError(
            f"the value function takes the group {value.group!r} of {value.shape['nobs']} observations, but the task "
            f"{env.task.name!r} has {groups}"
        )


def make_writable(network: nn.Module) -> None:
    """Replace buffers that were made in torch's inference mode, outside of which nothing can be written into them."""
    for part in network.modules():
        for name, buffer in list(part.named_buffers(recurse=False)):
            if buffer.is_inference():
                setattr(part, name, buffer.clone())


def _copy_statistics(source: nn.Module, target: nn.Module) -> None:
    """Copy those of rsl_rl's normaliser, which divides by the standard deviation plus ``eps``."""
    if isinstance(target, Normalizer):
        found = source.state_dict()
        mean, variance, std = (found[name].squeeze(0) for name in ("_mean", "_var", "_std"))
        target.count.copy_(found["count"])
        target.mean.copy_(mean)
        target.square.copy_(variance.double() * found["count"])
        target.shift.copy_(mean)
        target.scale.copy_((std + source.eps).reciprocal())


def _begin_with_statistics(target: nn.Module, source: nn.Module) -> None:
    """The reverse of ``_copy_statistics``."""
    if isinstance(source, Normalizer):
        variance = (source.square / source.count.clamp_min(1.0)).float()
        if source.count == 0:
            variance = torch.ones_like(variance)
        numbers = {"_mean": source.mean.float(), "_var": variance, "_std": variance.sqrt()}
        target.load_state_dict({name: part.unsqueeze(0) for name, part in numbers.items()} | {"count": source.count})
