"""Check policies and value functions that a user passes to an algorithm."""

from typing import Any

import torch

from lyceum_warp.algos.common.distributed import flatten
from lyceum_warp.algos.common.policy import GaussianPolicy
from lyceum_warp.algos.common.value import ValueFunction
from lyceum_warp.algos.natural_gradient import FisherProduct
from lyceum_warp.env import Env, moved
from lyceum_warp.support.validate import check_group, check_kind, described, first_sentence

_ROWS = 4


def check_policy(policy: object, env: Env, *, twice: bool = True) -> None:
    """Check that an algorithm can train a policy in an environment.

    The policy must be a ``GaussianPolicy``. It must map observations (..., nobs) to mean actions (..., nact)
    deterministically, and independently for each observation. It must be differentiable with respect to its trainable
    parameters. For NPG, the policy must be twice differentiable.

    Raises:
        ValueError: The policy violates one of these rules.
    """
    if not isinstance(policy, GaussianPolicy):
        kind = getattr(policy, "__name__", None) or type(policy).__name__
        fix = "lw.GaussianPolicy(nobs, nact, network=net) makes one from your own network"
        raise ValueError(f"policy must be a GaussianPolicy, not {kind}: {fix}")
    if twice and policy.state_size:
        raise ValueError("NPG cannot train a policy with memory: use lw.PPO, or a policy without memory")
    policy = moved(policy, env)
    check_sizes(policy, env)
    if not any(p.requires_grad for p in policy.parameters() if p is not policy.log_std):
        raise ValueError("the policy's network has no trainable parameter: use policy.requires_grad_(True)")
    if policy.pictures:  # memory and pictures need sequences of observations, and learners check their results
        return
    obs = env.obs.repeat(-(-_ROWS // env.nworld), 1)[:_ROWS]
    noise = torch.randn(obs.shape, generator=torch.Generator().manual_seed(0))
    obs = obs + 0.1 * noise.to(obs.device)
    _check_output(policy, obs)
    _check_derivatives(policy, obs, twice=twice)


def check_sizes(module: Any, env: Env, name: str = "the policy", *, group: str = "policy") -> None:
    """Check that a policy or critics fit an environment's observations and actions; error messages use ``name``.

    Raises:
        ValueError: The sizes of the module and the environment differ.
    """
    nact, pictures = env.action_space.size, getattr(module, "pictures", {})
    nobs = 0 if pictures and "policy" not in module.groups else env.obs_spaces[group].size
    for camera, shape in pictures.items():
        check_group(camera, env.obs_groups, env.task.name)
        if env.obs_spaces[camera].shape != shape:
            raise ValueError(f"{name} is made for pictures {shape}, but {camera!r} has {env.obs_spaces[camera].shape}")
    if (module.nobs, module.nact) != (nobs, nact):
        raise ValueError(
            f"{name} is made for {module.nobs} observations and {module.nact} actions, but the task "
            f"{env.task.name!r} has {nobs} observations and {nact} actions"
        )


@torch.no_grad()
def _check_output(policy: GaussianPolicy, obs: torch.Tensor) -> None:
    mean = _called(policy, obs)
    _called(policy, obs + 0.1)
    if mean.isfinite().all() and not torch.equal(mean, _called(policy, obs)):
        raise ValueError(
            "the policy gives two different mean actions for the same observations: a policy must not draw random "
            "numbers (for dropout, call eval() on its network) or keep state between calls"
        )
    if not mean.isfinite().all():
        raise ValueError("the policy's mean actions are not finite for finite observations")
    alone = torch.cat([_called(policy, row) for row in obs.split(1)])
    if not torch.allclose(mean, alone, rtol=0.0, atol=1e-2 * max(mean.abs().max().item(), 1e-6)):
        raise ValueError(
            "the policy's mean action depends on other rows of the batch, as with batch normalisation: use "
            "normalize=True, or LayerNorm"
        )


def _called(policy: GaussianPolicy, obs: torch.Tensor) -> torch.Tensor:
    mean: torch.Tensor = _outputs(policy, obs)[0]
    return mean


def _outputs(policy: GaussianPolicy, obs: torch.Tensor) -> tuple[Any, ...]:
    """Return the mean actions, and the next state of a policy with memory, for the state at an episode's start."""
    size = policy.state_size
    state = (obs.new_zeros(len(obs), size),) if size else ()
    try:
        result = policy.act(obs, *state)
    except Exception as error:  # a user's network may raise any error
        reason = f"{type(error).__name__}: {first_sentence(error)}"
        raise ValueError(f"the policy fails for observations of shape {tuple(obs.shape)} ({reason})") from error
    outputs = result if isinstance(result, tuple) else (result,)
    kinds = [described(x) if isinstance(x, torch.Tensor) else type(x).__name__ for x in outputs]
    expected = [described(x) for x in (obs.new_empty(len(obs), policy.nact), *state)]
    if kinds != expected:
        texts = [" and ".join(each) for each in (expected, kinds)]
        raise ValueError(
            f"the policy must give {texts[0]} for observations of shape {tuple(obs.shape)}, not {texts[1]}"
        )
    return outputs


def _check_derivatives(policy: GaussianPolicy, obs: torch.Tensor, *, twice: bool) -> None:
    named = [(name, p) for name, p in policy.named_parameters() if p.requires_grad and p is not policy.log_std]
    with torch.enable_grad():
        sums = sum(output.sum() for output in _outputs(policy, obs))
        if not sums.requires_grad:
            raise ValueError("the policy's mean actions depend on no parameter: remove detach() and no_grad()")
        gradients = torch.autograd.grad(sums, [p for _, p in named], allow_unused=True)
        if unused := [name for (name, _), gradient in zip(named, gradients, strict=True) if gradient is None]:
            raise ValueError(
                f"the policy's mean actions do not depend on its parameter {unused[0]!r}: use the parameter, without "
                "detach() or no_grad(), or freeze it with requires_grad_(False)"
            )
        if not twice:
            return
        try:
            product = FisherProduct(policy, obs, 0.0)(
                flatten(p.detach() for p in policy.parameters() if p.requires_grad)
            )
        except RuntimeError as error:
            raise ValueError(
                "the policy cannot be differentiated twice, which NPG needs for the Fisher information "
                f"({first_sentence(error)}): use other layers"
            ) from error
    if not product.isfinite().all():
        raise ValueError("the policy's derivatives are not finite")


def check_value(value: ValueFunction, env: Env, *, memory: bool = False) -> None:
    """Check that a value function fits an environment's observations, and has no memory unless ``memory`` is set.

    Raises:
        ValueError: The value function has the wrong type, its group or its input size does not fit, or a parameter is
            not finite.
    """
    check_kind("value", value, ValueFunction, "as lw.load_value(run) returns it for a run of NPG or PPO")
    if value.state_size and not memory:
        raise ValueError("only PPO can use a value function with memory: omit the value function")
    name = env.task.name
    check_group(value.group, env.obs_groups, name)
    size, space = value.shape["nobs"], env.obs_spaces[value.group]
    if size != space.size:
        raise ValueError(
            f"the value function takes {size} observations, but the group {value.group!r} of the task {name!r} has "
            f"{space.size} observations"
        )
    for part, numbers in value.state_dict().items():
        if not numbers.isfinite().all():
            raise ValueError(
                f"the value function's {part!r} is not finite: omit the value function to get a new value function"
            )
